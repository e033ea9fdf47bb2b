"""Mutants of steps on the device."""

MUTANTS = {
    "openmm/device/kernels.py": [
        (
            "done[-1]._replace(share=done[-1].share «+→-» op.share)",
            "test_device_integrator.py::test_operations_are_joined_where_nobody_looks",
        ),
        (
            "step+({op.begun}), {{}}, «seed[0]→7»);",
            "test_device_integrator.py::test_noise_belongs_to_particle_and_step",
        ),
        (
            "link[k] = (link[k]*damp+h*push«/2→»)*damp;",
            "test_device_integrator.py::test_settings_change_what_is_done",
        ),
        (
            "scale = 1+(1«-→+»cosine)*twice/2;",
            "test_molecule_spheres.py::test_trajectories_are_those_on_arrays",
        ),
    ],
    "openmm/device/build.py": [
        (
            "if not (accelerated() «or→and» is_built()):",
            "test_device_integrator.py::test_which_steps_are_made_on_the_device",
        ),
    ],
    "plan/clusters_alike.py": [
        (
            "key=lambda k: («k in last, →»k)",
            "test_rows.py::test_levels_have_rows_that_share_no_entry",
        ),
        (
            "level[min(mine)] = «max(level[min(mine)], level[place] + 1)→level[place] + 1»",
            "test_rows.py::test_levels_have_rows_that_share_no_entry",
        ),
    ],
    "openmm/device/small_clusters.py": [
        (
            '"there« && last→»"',
            "test_surfaces_on_the_device.py::test_the_device_holds_the_same_surfaces",
        ),
    ],
    "openmm/device/device_integrator.py": [
        (
            "self._advance(context, again«→ - 1»)",
            "test_device_integrator.py::test_a_failure_leaves_the_state_before_the_step",
        ),
        (
            "yield x, v, f, time + (k «+ 1→+ 0») * every * self._dt",
            "test_device_integrator.py::test_records_are_the_states_after_steps",
        ),
        (
            "if part.left «!=→is None and» guard.context.getTime()._value:",
            "test_kernel_rows.py::test_multipliers_are_summed_where_the_rows_are",
        ),
        (
            "if told[_FAILED]«→ and False»:",
            "test_device_integrator.py::test_rows_without_solution_are_told_and_taken_back",
        ),
    ],
}
