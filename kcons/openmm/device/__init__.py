"""Steps on the device: a plugin of OpenMM that runs the operations of a step as a few kernels.

- `clusters`: families and clusters of rows as C
- `kernels`: operations as the text of kernels, the same for every platform
- `rows`: all rows for the kernels, and as the part of an integrator
- `build`: the plugin, compiled where it is used
- `device_integrator`: the integrator that has it
- `wheel`: the plugin as a wheel
"""
