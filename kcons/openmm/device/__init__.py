"""Steps on the device: a plugin of OpenMM that runs the operations of a step as a few kernels.

- `c_writer`: families of constraints as C
- `held_rows`: what is held: constraint objects of parts, clusters that look alike
- `kernels`: operations as the text of kernels, the same for every platform
- `small_clusters`: a cluster in the registers of a work-item
- `large_clusters`: tables of clusters that have a work-group
- `rows`: all rows for the kernels
- `kernel_rows`: rows as the part of an integrator
- `build`: the plugin, compiled where it is used
- `device_integrator`: the integrator that has it
- `wheel`: the plugin as a wheel
"""
