"""Mutants of studies."""

MUTANTS = {
    "steppers/files.py": {
        "and «not math.isfinite(value)→False» else value": "steppers/files::data_as_json",
    },
    "comparison/averages.py": {
        'found["error"] = max((abs(found[k]) «+ 2 * found[f"{k}_error"] →»for k in known), default=math.nan)': (
            "comparison/averages::temperatures_are_right_at_a_fine_step_and_evaluations_are_counted"
        ),
        "«force = ForceGroups.difference(self.cheap.forces, force)→pass»": (
            "comparison/averages::temperatures_are_right_at_a_fine_step_and_evaluations_are_counted"
        ),
    },
    "comparison/test_systems/registry.py": {
        "if «entry.only and size != entry.siz→Fals»e:": "test_systems::a_test_system_of_ones_own",
    },
    "comparison/runs.py": {
        "return x« / self.length, v / self.speed→, v»": "methods::lines_of_python_end_where_the_run_ends",
    },
    "comparison/ranking.py": {
        "if «cost > leader * (1 + same)→True»:": "ranking::costs_within_the_scatter_share_a_place",
        "beyond = done«[~done.method.isin(good.method)]→»": "ranking::the_cheapest_that_is_as_good_as_the_usual",
    },
    "comparison/measure.py": {
        "if «method.name not in ther→Tru»e:": "cli/compare::it_goes_on_from_the_rows_that_are_there",
        "if wrong and «method.holds→False»:": "comparison/measure::what_a_method_raises_or_does_wrong_is_a_result",
        ", max(self.seconds, 1e-3)«, RING_AGAIN→»)": "comparison/measure::what_a_finalizer_swallows_is_raised_again",
        '«row["seconds"] *= step / row["step_seconds"]→pass»': (
            "measure::a_row_a_method_and_setting_and_beside_them_what_they_are_of"
        ),
    },
    "comparison/report.py": {
        "height = max(height« + least→», float(": "comparison/report::no_name_is_cut_or_covers_another",
    },
    "openmm/collective/collective_rows.py": {
        "._single« or p.halves→»)": "row_program::the_second_half_of_a_drift_begins_in_the_middle",
    },
    "free_energy/windows/driver.py": {
        "= covariance + «→0 * »np.outer(half,": "free_energy::sides_that_differ_by_more_than_chance_widen_the_error",
    },
    "free_energy/held_coordinates.py": {
        "gradient[:, j] += mixed[:, «s→j»]": "held_coordinates::mean_force_is_the_one_of_the_definition",
        "d * d«] @ shares.swapaxes(1, 2)→, -d:]»": "held_coordinates::mean_force_is_the_one_of_the_definition",
        "bent[:, 1 + d * d :].sum(axis=1) «-→+» traces)": "held_coordinates::mean_force_is_the_one_of_the_definition",
        "(respond @ b[:, :, None] «-→+» pull)": "held_coordinates::mean_force_is_the_one_of_the_definition",
        "return «abs(after - before) < _SAME→True»": "torsion_force::other_rows_must_not_change",
        "arms = x[..., self.group, :]« - x[..., self.axis[1:], :]→»": (
            "torsion_force::the_smaller_group_turns_and_its_force_is_the_slope_of_the_energy"
        ),
    },
    "free_energy/series.py": {
        "series.kinetic / «(g - 1) if g→g if g > 99»": "mean_forces::one_end_to_end_length_beside_two_bonds",
        "[:, k]) / spread * «difference→away / 2»": "mean_forces::of_two_estimates_the_mixture_that_fluctuates_least",
    },
    "free_energy/profiles/profile.py": {
        "aims = grid[«→~»self.lower_than(below)]": "profile::windows_that_help_what_is_low",
    },
}
