"""What all studies share.

- `json_files`: results in files
- `machine`: where something was measured, and with what code
- `scripts`: calls timed in turn, tables, options of scripts
- `html_page`: one self-contained HTML page
"""
