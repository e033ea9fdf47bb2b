"""Averages of thermostats, and how far they are off after how much time.

- `sampling`: fluids run and measured
- `layers`: systems with expensive and cheap forces
- `long_steps`, `long_steps_report`: bias against evaluations of expensive forces
- `step_zero`: averages at step zero
- `trajectory_temperatures`: those of a trajectory of any engine
- `volumes`: series at constant pressure, and what a barostat costs
- `ranking`, `report`: which thermostat; tables, plots and files
"""
