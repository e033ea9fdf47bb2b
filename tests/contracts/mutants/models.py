"""Mutants of growth, flows, notes and multibody systems."""

MUTANTS = {
    "models/growth/constrained.py": [
        ("for _ in range(«2→1» if k else 0):", "test_constrained.py::test_nearly_parallel_rows_stay_orthogonal"),
        ("LOST = 1e-1«2→1»", "test_constrained.py::test_rows_count_as_dependent_below_a_part_in_a_million_million"),
        ("LOST = 1e-1«2→3»", "test_constrained.py::test_rows_count_as_dependent_below_a_part_in_a_million_million"),
        (
            "SOLVABILITY_TOLERANCE = 1e-«9→8»",
            "test_constrained.py::test_dependent_rows_may_disagree_by_a_part_in_a_thousand_million",
        ),
        (
            "SOLVABILITY_TOLERANCE = 1e-«9→10»",
            "test_constrained.py::test_dependent_rows_may_disagree_by_a_part_in_a_thousand_million",
        ),
    ],
    "steppers/stages/compiled_operations.py": [
        ("(«(r * n - d) + →»r", "test_flights.py::test_great_circles_end_on_the_sphere_wherever_they_start"),
    ],
    "models/growth/model.py": [
        ("self.alpha1 / self.beta«1→2»])", "test_models.py::test_lotka_volterra_with_four_different_parameters"),
    ],
    "models/growth/rows.py": [
        ('return «-→»float(called(f"time der', "test_constrained.py::test_values_stay_along_the_velocity_of_the_rows"),
        ("lambda t, x: «-→»self._moved(t)[1]", "test_constrained.py::test_values_stay_along_the_velocity_of_the_rows"),
    ],
    "models/flows/known_flows.py": [
        ("complex(-0.5 * (self.eta «+→-» a))", "test_known_flows.py::test_damped_oscillator_reference"),
        ("complex(«-→»0.5 * (self.eta + a))", "test_known_flows.py::test_damped_oscillator_reference"),
        (
            "«self.omega * (self.omega / first→0.5 * (a - self.eta»))",
            "test_known_flows.py::test_oscillator_eigenvalues_to_the_last_digits",
        ),
        (
            "[[«second / self.omega, first→first / self.omega, second» / self.omega]",
            "test_known_flows.py::test_jordan_form_of_the_oscillator",
        ),
    ],
    "models/flows/linear.py": [
        (
            "noise = «len(A) * EPSILON * float(np.linalg.norm(balanced))→0.0»",
            "test_linear.py::test_errors_hold_and_are_not_much_too_large",
        ),
        ("np.all(real > «off→0»)", "test_linear.py::test_what_is_said_is_so"),
        ("«p.quo(common) * →»once", "test_linear.py::test_eigenvalues_on_the_axis_are_counted_in_integers"),
        (
            "certain = «closer == 1.0 and →»kept",
            "test_linear.py::test_neighbors_that_rounding_joins_are_told_as_uncertain",
        ),
    ],
    "models/flows/mechanics.py": [
        (
            "np.concatenate([slope[self.f :], «-→»slope[: self.f]])",
            "test_mechanics.py::test_friction_by_a_hamiltonian_that_depends_on_time",
        ),
    ],
    "constraints/projection.py": [
        ("vt[kept].«conj().→»T)", "constraints/test_projection.py::test_complex_matrices"),
    ],
    "models/multibody.py": [
        (
            "self.N.T @ «(f - self.M @ a)→f»",
            "test_multibody.py::test_one_place_against_the_theory test_multibody.py::test_a_linear_change_of_"
            "coordinates_changes_nothing",
        ),
        (
            "left[rank - 1] > «DEPENDENT * left[0]→0.0»",
            "test_multibody.py::test_a_crossing_of_two_ways_is_passed_straight_on",
        ),
        (
            "for _ in range(«ITERATIONS→1»):",
            "test_multibody.py::test_a_start_off_the_constraints_is_refused_and_can_be_mended",
        ),
    ],
    "models/integration.py": [
        ("        «told.clear()→pass»\n", "test_multibody.py::test_what_ends_a_run_is_told_not_what_was_got_over"),
        ("«self.D[0] += y - self.y→pass»", "test_integration.py::test_the_next_step_starts_from_the_projection"),
    ],
    "solvers/sparse/row_functions.py": [
        ("_from(p, «stride→0» * i)", "test_rows_at_once.py::test_values_and_gradients_are_those_of_one_row"),
        ("alike[«first + size - 1→:»] = True", "test_rows_at_once.py::test_who_is_called_one_by_one"),
        (
            "and before[1] == time« and before[2] == value→»:",
            "test_row_functions.py::test_a_gradient_is_found_again_where_the_value_has_changed",
        ),
    ],
}
