"""Mutants of studies."""

MUTANTS = {
    "steppers/files.py": [
        ("and «not math.isfinite(value)→False» else value", "steppers/test_files.py::test_data_as_json"),
    ],
    "comparison/averages.py": [
        (
            'found["error"] = max((abs(found[k]) «+ 2 * found[f"{k}_error"] →»for k in known), default=math.nan)',
            "comparison/test_averages.py::test_temperatures_are_right_at_a_fine_step_and_evaluations_are_counted",
        ),
        (
            "«force = ForceGroups.difference(self.cheap.forces, force)→pass»",
            "comparison/test_averages.py::test_temperatures_are_right_at_a_fine_step_and_evaluations_are_counted",
        ),
    ],
    "comparison/test_systems/registry.py": [
        ("if «entry.only and size != entry.siz→Fals»e:", "test_test_systems.py::test_a_test_system_of_ones_own"),
    ],
    "comparison/runs.py": [
        (
            "return x« / self.length, v / self.speed→, v»",
            "test_methods.py::test_lines_of_python_end_where_the_run_ends",
        ),
    ],
    "comparison/ranking.py": [
        (
            "if «cost > leader * (1 + same) or not places→True»:",
            "test_ranking.py::test_costs_within_the_scatter_share_a_place",
        ),
        ("beyond = done«[~done.method.isin(good.method)]→»", "test_ranking.py::test_an_error_that_is_asked_for"),
    ],
    "comparison/measure.py": [
        ("if «method.name not in ther→Tru»e:", "test_measure.py::test_methods_that_are_there_are_not_run_again"),
        (
            "setitimer(signal.ITIMER_REAL, max(self.seconds, 1e-3)«, RING_AGAIN→»)",
            "comparison/test_measure.py::test_what_a_finalizer_swallows_is_raised_again",
        ),
        ('«row["seconds"] *= step / row["step_seconds"]→pass»', "test_measure.py::test_a_row_a_method_and_setting"),
    ],
    "comparison/report.py": [
        ("height = max(height« + least→», float(", "comparison/test_report.py::test_no_name_is_cut_or_covers_another"),
    ],
    "openmm/collective/collective_rows.py": [
        (
            "(not self._single« or p.halves→»)",
            "test_row_program.py::test_the_second_half_of_a_drift_begins_in_the_middle",
        ),
    ],
    "free_energy/windows/driver.py": [
        (
            "covariance = covariance + «→0 * »np.outer(half, half)",
            "test_free_energy.py::test_sides_that_differ_by_more_than_chance_widen_the_error",
        ),
    ],
    "free_energy/held_coordinates.py": [
        ("result[:, j] += mixed[:, «s→j»]", "test_held_coordinates.py::test_mean_force_is_the_one_of_the_definition"),
        (
            "bent[:, 1 : 1 + d * d«] @ metric.shares.swapaxes(1, 2)→, -d:]»",
            "test_held_coordinates.py::test_mean_force_is_the_one_of_the_definition",
        ),
        (
            "bent[:, 1 + d * d :].sum(axis=1) «-→+» traces)",
            "test_held_coordinates.py::test_mean_force_is_the_one_of_the_definition",
        ),
        ("(respond @ b[:, :, None] «-→+» pull)", "test_held_coordinates.py::test_multipliers_are_those_of_the_engine"),
    ],
    "free_energy/mean_forces.py": [
        (
            "series.kinetic / «(g - 1) if g→g if g > 99»",
            "test_mean_forces.py::test_one_end_to_end_length_beside_two_bonds",
        ),
        (
            "np.mean(away * force[:, k]) / spread * «difference→away / 2»",
            "test_mean_forces.py::test_of_two_estimates_the_mixture_that_fluctuates_least",
        ),
    ],
    "free_energy/torsion_force.py": [
        (
            "np.isfinite(before)« and abs(after - before) < _SAME→»",
            "test_torsion_force.py::test_other_rows_must_not_change",
        ),
        (
            "arms = x[..., self.group, :]« - x[..., self.axis[1:], :]→»",
            "test_torsion_force.py::test_the_smaller_group_turns_and_its_force_is_the_slope_of_the_energy",
        ),
    ],
    "free_energy/profiles/profile.py": [
        ("aims = grid[«→~»self.lower_than(below)]", "test_profile.py::test_windows_that_help_what_is_low"),
    ],
}
