"""Mutants of scans and free energies."""

MUTANTS = {
    "free_energy/scans/relaxed_scan.py": [
        (
            "attempt.energy «<→>» best[point].energy:",
            "test_relaxed_scan.py::test_both_ways_find_the_lower_of_two_minima",
        ),
        ("if «with_it.rank != rank + n + 1→False»:", "free_energy/test_refusals.py::test_refusals"),
        (
            "if attempt is «not None and (attempt.point, attempt.source) != (point, source)→None and source == point»:",
            "test_relaxed_scan.py::test_relaxations_in_files_are_whole_and_of_this_scan",
        ),
    ],
    "free_energy/scans/relaxation.py": [
        ("missing = change - size «-→+» self._learned(move)", "test_relaxation.py::test_what_was_learned_goes_along"),
        (
            "return [«x[atoms] +→lined_up(x[atoms], self.lattice) + 0 *» images for",
            "test_relaxation.py::test_terms_keep_their_images",
        ),
    ],
    "free_energy/windows/input_file.py": [
        (
            "np.where([item.held «is ANGLE→is not None» for item",
            "free_energy/windows/test_input_file.py::test_a_difference_of_distances",
        ),
        (
            'return np.radians(places) if «family in ("angle", "dihedral")→family != "distance"» else places',
            "free_energy/windows/test_input_file.py::test_a_difference_of_distances",
        ),
    ],
    "cli/scan.py": [
        (
            'values.append(np.radians(axis) if «family in ("angle", "dihedral")→family != "distance"» else axis)',
            "cli/test_scan.py::test_a_difference_of_distances",
        ),
    ],
    "free_energy/windows/driver.py": [
        (
            "self._failed.«pop(job.name, None→clear(»)",
            "test_driver.py::test_windows_that_failed_before_others_are_added_are_still_told_of",
        ),
        ("    finally:\n        «os._exit(1)→pass»", "test_driver.py::test_workers_end_with_what_waits_for_them"),
    ],
    "ase/named_calculators.py": [
        (
            "if «module not in modules→False»:",
            "test_named_calculators.py::test_files_name_calculators_of_a_list_or_of_modules_that_their_reader_names",
        ),
    ],
    "free_energy/torsion_force.py": [
        (
            "{*pair} not in joined« and bonded.issuperset(pair)→»",
            "test_ase_windows.py::test_torsions_over_atoms_that_form_no_bonds",
        ),
    ],
    "constraints/target.py": [
        (
            "    return difference« - period * np.round(difference / whole)→»",
            "test_custom.py::test_differences_where_the_value_jumps_by_its_period test_target.py::test_a_targ"
            "et_that_jumps_by_its_period_does_not_move_faster_there",
        ),
    ],
    "openmm/integrator/guard.py": [
        (
            "«        refuse_forgotten_parts(self.system, integrator.row_groups)\n→»",
            "openmm/integrator/test_edits.py::test_forgotten_parts_are_refused",
        ),
    ],
    "free_energy/averages.py": [
        (
            "covariance *= «np.outer(widening, widening)→1.0»",
            "test_correlated_series.py::test_errors_are_as_large_as_they_say",
        ),
        (
            "fluctuation = «factors[:, None]→1.0» * (series",
            "free_energy/test_averages.py::test_weights_that_belong_to_the_values",
        ),
    ],
    "free_energy/profiles/gaussian_process.py": [
        (
            "bend * first**2 «+→-» slope * second",
            "test_gaussian_process.py::test_covariances_of_gradients_are_derivatives_of_those_of_the_free_energy",
        ),
        (
            "square = «(2 * radius * np.sin(away / (2 * radius))) ** →away**»2",
            "test_gaussian_process.py::test_a_period_further_nothing_is_different",
        ),
        (
            "axes=1)« + (away.T * self.weights) @ away→»)",
            "test_gaussian_process.py::test_an_average_over_processes_has_the_moments_of_a_mixture",
        ),
    ],
    "free_energy/profiles/profile.py": [
        ("process = process«.closed()→»", "test_profile.py::test_a_period_closes"),
    ],
    "free_energy/profiles/mean_force_surface.py": [
        (
            "if chance < «_CHANCE→0.0»:",
            "test_mean_force_surface.py::test_vectors_that_are_no_gradient_are_warned_of",
        ),
    ],
    "free_energy/profiles/pulls.py": [
        ("np.asarray(«math.log(works.shape[-1]) →»- logsumexp(-works", "test_pulls.py::test_a_spring_that_is_dragged"),
        ("ahead, «-back→back»]) - difference", "test_pulls.py::test_works_of_no_spread"),
    ],
    "constraints/constraint_set.py": [
        (
            "if any(«getattr(item, name) != getattr(wanted, name)→name is None» for name in wanted.shared):",
            "test_held_coordinates.py::test_formulas_on_the_same_atoms_are_told_apart",
        ),
    ],
}
