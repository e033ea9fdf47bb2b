"""Averages of thermostats, and how far they are off after how much time.

- `sampling`: fluids run and measured
- `report`: tables, plots and files
"""
