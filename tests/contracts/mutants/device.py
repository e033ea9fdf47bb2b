"""Mutants of steps on the device."""

MUTANTS = {
    "openmm/device/kernels.py": {
        "sum(g - «g→0» / (g + self": "molecule_spheres::configurations_are_canonical_at_long_steps",
        "_replace(share=done[-1].share «+→-» op.share": "device_integrator::operations_are_joined_where_nobody_looks",
        "step+({op.begun}), {{}}, «seed[0]→7»);": "device_integrator::noise_belongs_to_particle_and_step",
        "link[k] = (link[k]*damp+h*push«/2→»)*damp;": "device_integrator::settings_change_what_is_done",
        "self._tangent(push, «summed=True→»)": "kernel_rows::multipliers_of_ensembles_are_those_of_configurations",
        'd[3*a+c];}}\\n }}\\n", summed=«True→False»)': (
            "kernel_rows::multipliers_of_ensembles_are_those_of_configurations"
        ),
        "scale = 1+(1«-→+»cosine)*twice/2;": "molecule_spheres::trajectories_are_those_on_arrays",
    },
    "openmm/device/rows.py": {
        "if «not item.n_rows→False»:": "rows::constraints_of_no_rows_hold_nothing",
        "np.isin(pairs, fixed).all(axis=1) «& rounded→»": "kernel_rows::fixed_atoms_of_rigid_water_in_single_precision",
        "#define ROWS_PIVOT ((mixed) {«PIVOT_SINGLE→PIVOT_TOLERANCE»})": "kernel_rows::multipliers_in_single_precision",
        "{volatile mixed y_ = -(impulse)«-lost[row]→», t_": "kernel_rows::multipliers_in_single_precision",
        "part._engine._integrator = «weakref.ref(integrator)→other»": (
            "kernel_rows::states_with_energies_of_rows_of_hold_that_move"
        ),
    },
    "openmm/device/plugin/steps.h": {
        "numbers.time = «→(float) »c.getTime()-shared.origin;": "kernel_rows::targets_move_late_in_a_long_run",
    },
    "openmm/device/plugin/program_integrator.cpp": {
        "«steps->valid = false;→»   ": "device_integrator::others_move_positions_and_velocities",
        'array.name != «"memory"→""»;': "device_integrator::states_of_other_rows_are_refused",
        '!(«exactly→false» && array.name == "seed")': "device_integrator::replicas_of_openmm_have_noise_of_their_own",
    },
    "plan/clusters.py": {
        "for k in left if not «(k in last and coupled[k] - last)→False»]": "rows::levels_have_rows_that_share_no_entry",
        "if «k not in beside→True» and count": "rows::levels_have_rows_that_share_no_entry",
    },
    "openmm/device/clusters.c": {
        "if («missed > 0→1») {": "rows::rows_without_a_solution_are_told",
    },
    "openmm/device/clusters.py": {
        "off[bad]«/unit[bad]→»); return": "rows::rows_without_a_solution_are_told",
        "'+' if one[a] «==→!=» other[a] else": "rows::clusters_of_all_sizes",
        '"there« && last→»"': "surface_integrator::the_device_holds_the_same_surfaces",
    },
    "openmm/device/device_integrator.py": {
        "or build.accelerated() «or→and» (build.is_built()": "device_integrator::which_steps_are_made_on_the_device",
        "cells.get(«array.name→0», array": "device_integrator::a_compound_integrator_begins_with_rows_through_faces",
        "array in «arrays→rows.arrays» if array.saved": "molecule_spheres::a_failure_puts_auxiliary_variables_back",
        "np.isfinite(told[_RESIDUAL])«→ and False»:": "device_integrator::a_failure_puts_back_what_was_checked_last",
        "yield x, v, f, time + «k→(k - 1)» * every * self": "device_integrator::records_are_the_states_after_steps",
        "part.left «!=→is None and» guard.context.getTime(": "kernel_rows::multipliers_are_summed_where_the_rows_are",
        "part if part.program is None «else copy.deepcopy(part)→else part»": (
            "kernel_rows::parts_serve_integrators_of_other_systems"
        ),
        "if told[_FAILED]«→ and False»:": "device_integrator::a_failure_puts_back_what_was_checked_last",
    },
}
