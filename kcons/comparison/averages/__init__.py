"""Averages of thermostats, and how far they are off after how much time.

- `sampling`: fluids run and measured
- `step_zero`: averages at step zero
- `report`: tables, plots and files
"""
