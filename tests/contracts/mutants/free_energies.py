"""Mutants of scans and free energies."""

MUTANTS = {
    "free_energy/scans/relaxed_scan.py": {
        "attempt.energy «<→>» best[point].energy:": "relaxed_scan::both_ways_find_the_lower_of_two_minima",
        "if attempt is «not None and (attempt.point, attempt.source) != (point, source)→None and source == point»:": (
            "relaxed_scan::relaxations_in_files_are_whole_and_of_this_scan"
        ),
    },
    "free_energy/scans/relaxation.py": {
        "missing = change - size «-→+» self._learned(move)": "relaxation::what_was_learned_goes_along",
        "[«x[atoms] +→lined_up(x[atoms], self.lattice) + 0 *» images for": "relaxation::terms_keep_their_images",
    },
    "free_energy/windows/input_file.py": {
        "[atom «- first→» for atom in atoms]": "free_energy/windows/input_file::a_difference_of_distances",
        'return np.radians(places) if «self.family in ("angle", "dihedral")→self.family != "distance"» else places': (
            "free_energy/windows/input_file::a_difference_of_distances"
        ),
    },
    "cli/free_energy.py": {
        "made.constraint(«chosen.count_from→0»)": "cli/scan::a_torsion",
    },
    "free_energy/windows/driver.py": {
        ".«pop(job.name, None→clear(»)": "driver::windows_that_failed_before_others_are_added_are_still_told_of",
        "«os._exit(1)→pass»": "driver::workers_end_with_what_waits_for_them",
        "np.minimum(target, «np.pi - target→np.pi»)": "driver::runs_of_an_angle_begin_at_angles",
        "«(folder / left).unlink(missing_ok=True)→pass»": (
            "free_energy/windows/free_energy::no_profile_of_other_windows_is_left"
        ),
    },
    "ase/named_calculators.py": {
        "if «module not in modules→False»:": (
            "named_calculators::files_name_calculators_of_a_list_or_of_modules_that_their_reader_names"
        ),
        "(initial, «atoms.info→None»)": "named_calculators::what_tells_calculators_from_each_other",
    },
    "free_energy/held_coordinates.py": {
        "if «dependent→False»:": "free_energy/refusals::refusals",
        "{*pair} not in joined« and bonded.issuperset(pair)→»": "ase_windows::torsions_over_atoms_that_form_no_bonds",
    },
    "constraints/target.py": {
        "    return difference« - period * np.round(difference / whole)→»": (
            "formula::differences_where_the_value_jumps_by_its_period "
            "target::a_target_that_jumps_by_its_period_does_not_move_faster_there"
        ),
    },
    "openmm/integrator/guard.py": {
        "force.getForceGroup() not in «row_groups→range(32)»": "openmm/integrator/edits::forgotten_parts_are_refused",
        "name in BAROSTATS« and force.getFrequency() > 0→»": "hold::a_barostat_of_frequency_0_is_off",
        '(type(force), «getattr(force, "getFrequency", bool)()→0»)': "hold::a_barostat_of_frequency_0_is_off",
    },
    "free_energy/averages.py": {
        "covariance *= «np.outer(widening, widening)→1.0»": "correlated_series::errors_are_as_large_as_they_say",
        "fluctuation = «factors[:, None]→1.0» * (series": "free_energy/averages::weights_that_belong_to_the_values",
    },
    "free_energy/profiles/gaussian_process.py": {
        "**2 «+→-» slope *": "gaussian_process::covariances_of_gradients_are_derivatives_of_those_of_the_free_energy",
        "square = «(2 * radius * np.sin(away / (2 * radius))) ** →away**»2": "profile::a_period_closes",
        "axes=1)« + (away.T * self.weights) @ away→»)": (
            "gaussian_process::an_average_over_processes_has_the_moments_of_a_mixture"
        ),
    },
    "free_energy/profiles/profile.py": {
        "process = process«.closed()→»": "profile::a_period_closes",
        "sizes[-1] < «1.0→0.0»": "profile::waves_without_a_slope_at_any_window_are_said",
        "if chance < «_CHANCE→0.0»:": "mean_force_surface::vectors_that_are_no_gradient_are_warned_of",
    },
    "free_energy/profiles/pulls.py": {
        "Estimate(kT * difference, «kT * →»error)": "pulls::normal_works_give_the_free_energy_within_the_errors",
        "ahead, «-back→back»]) - difference": "pulls::works_of_no_spread",
    },
    "constraints/constraint_set.py": {
        "or any(«getattr(item, name) != getattr(wanted, name)→name is None» for name in wanted.shared)": (
            "held_coordinates::formulas_on_the_same_atoms_are_told_apart"
        ),
    },
}
