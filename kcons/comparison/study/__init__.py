"""What all studies share.

- `json_files`: results in files
- `asked`: what is asked for by name
- `tables`, `curves`: what is shown, and its writers
- `report_files`: the files of a report
"""
