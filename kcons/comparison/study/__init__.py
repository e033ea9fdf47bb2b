"""What all studies share.

- `json_files`: results in files
- `machine`: where something was measured, and with what code
- `study`: pieces of work, kept and resumed
- `scripts`: calls timed in turn, tables, options of scripts
- `tables`, `curves`: what is shown, and its writers
- `report_files`: the files of a report
- `html_page`: one self-contained HTML page
"""
