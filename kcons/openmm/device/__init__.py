"""Steps on the device: a plugin of OpenMM that runs the operations of a step as a few kernels.

- `kernels`: operations as the text of kernels, the same for every platform
- `build`: the plugin, compiled where it is used
- `device_integrator`: the integrator that has it
- `wheel`: the plugin as a wheel
"""
