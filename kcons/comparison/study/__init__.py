"""What all studies share.

- `json_files`: results in files
- `study`: pieces of work, kept and resumed
- `scripts`: calls timed in turn, tables, options of scripts
- `tables`, `curves`: what is shown, and its writers
- `report_files`: the files of a report
"""
