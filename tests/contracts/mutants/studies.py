"""Mutants of studies."""

MUTANTS = [
    # -- studies: what is kept, and what is shown --
    (
        "steppers/files.py",
        "if not math.isfinite(value):",
        "if False:",
        "tests/comparison/study/test_json_files.py::test_what_json_lacks_becomes_what_it_has",
    ),
    (
        "comparison/study/tables.py",
        "if table.grouped and k else shown",
        "if table.grouped else shown",
        "tests/comparison/study/test_tables.py::test_groups_are_named_once_and_set_apart",
    ),
    (
        "comparison/study/curves.py",
        'given: dict[str, Any] = {"transform": places[curve.along]} if curve.along else {}',
        "given: dict[str, Any] = {}",
        "tests/comparison/study/test_curves.py::test_marks_along_an_edge_do_not_count_as_data",
    ),
    (
        "comparison/runs.py",
        "return x / self.length, v / self.speed",
        "return x, v",
        "tests/comparison/test_methods.py::test_lines_of_python_end_where_the_run_ends",
    ),
    (
        "comparison/ranking.py",
        "if cost > leader * (1 + same) or not places:",
        "if True:",
        "tests/comparison/test_ranking.py::test_costs_within_the_scatter_share_a_place",
    ),
    (
        "comparison/ranking.py",
        "beyond = done[~done.method.isin(good.method)]",
        "beyond = done",
        "tests/comparison/test_ranking.py::test_an_error_that_is_asked_for",
    ),
    (
        "comparison/measure.py",
        "if method.name not in there:",
        "if True:",
        "tests/comparison/test_measure.py::test_methods_that_are_there_are_not_run_again",
    ),
    (
        "comparison/measure.py",
        'row["seconds"] *= step / row["step_seconds"]',
        "pass",
        "tests/comparison/test_measure.py::test_a_row_a_method_and_setting",
    ),
    (
        "comparison/report.py",
        "height = max(height + least, float(",
        "height = max(height, float(",
        "tests/comparison/test_report.py::test_no_name_is_cut_or_covers_another",
    ),
    (
        "openmm/collective/row_program.py",
        "if not self._single or _halved(integrator, scheme):",
        "if not self._single:",
        "tests/openmm/collective/test_row_program.py::test_the_second_half_of_a_drift_begins_in_the_middle",
    ),
    (
        "free_energy/windows/window_results.py",
        "covariance = covariance + np.outer(half, half)",
        "covariance = covariance + 0 * np.outer(half, half)",
        "tests/free_energy/windows/test_window_results.py::test_sides_that_differ_by_more_than_chance_widen_the_error",
    ),
    (
        "free_energy/held_coordinates.py",
        "result[j] += mixed[s]",
        "result[j] += mixed[j]",
        "tests/free_energy/test_compiled_samples.py::test_the_same_as_the_general_formulas",
    ),
    (
        "free_energy/held_coordinates.py",
        "return seen if others is None else seen + metric.reactions @ others",
        "return seen if others is None else seen - metric.reactions @ others",
        "tests/free_energy/test_compiled_samples.py::test_the_same_as_the_general_formulas",
    ),
    (
        "free_energy/compiled_samples.py",
        "out[j] += there[s]",
        "out[j] += there[j]",
        "tests/free_energy/test_held_coordinates.py::test_mean_force_is_the_one_of_the_definition",
    ),
    (
        "free_energy/compiled_samples.py",
        "answer[k] = -product[i, d + k]",
        "answer[k] = product[i, d + k]",
        "tests/free_energy/test_held_coordinates.py::test_multipliers_are_those_of_the_engine",
    ),
    (
        "free_energy/mean_forces.py",
        "series.kinetic / (g - 1) if g",
        "series.kinetic / g if g > 99",
        "tests/free_energy/test_mean_forces.py::test_one_end_to_end_length_beside_two_bonds",
    ),
    (
        "free_energy/mean_forces.py",
        "np.mean(away * force[:, k]) / spread * difference",
        "np.mean(away * force[:, k]) / spread * away / 2",
        "tests/free_energy/test_mean_forces.py::test_of_two_estimates_the_mixture_that_fluctuates_least",
    ),
    (
        "free_energy/rigid_turns.py",
        "np.isfinite(before) and abs(after - before) < _SAME",
        "np.isfinite(before)",
        "tests/free_energy/test_rigid_turns.py::test_other_rows_must_not_change",
    ),
    (
        "free_energy/rigid_turns.py",
        "u, v, w = x[atom, 0] - x[near, 0],",
        "u, v, w = x[atom, 0],",
        "tests/free_energy/test_rigid_turns.py::test_the_smaller_group_turns_and_its_force_is_the_slope_of_the_energy",
    ),
    (
        "free_energy/profiles/profile.py",
        "aims = grid[self.lower_than(below, grid)]",
        "aims = grid[~self.lower_than(below, grid)]",
        "tests/free_energy/profiles/test_profile.py::test_windows_that_help_what_is_low",
    ),
]
