"""Mutants of growth, flows, notes and multibody systems."""

MUTANTS = [
    # -- growth, flows, notes --
    (
        "models/growth/constrained.py",
        "for _ in range(2 if k else 0):",
        "for _ in range(1 if k else 0):",
        "tests/models/growth/test_constrained.py::test_nearly_parallel_rows_stay_orthogonal",
    ),
    (
        "models/growth/constrained.py",
        "LOST = 1e-12",
        "LOST = 1e-11",
        "tests/models/growth/test_constrained.py::test_rows_count_as_dependent_below_a_part_in_a_million_million",
    ),
    (
        "models/growth/constrained.py",
        "LOST = 1e-12",
        "LOST = 1e-13",
        "tests/models/growth/test_constrained.py::test_rows_count_as_dependent_below_a_part_in_a_million_million",
    ),
    (
        "models/growth/constrained.py",
        "SOLVABILITY_TOLERANCE = 1e-9",
        "SOLVABILITY_TOLERANCE = 1e-8",
        "tests/models/growth/test_constrained.py::test_dependent_rows_may_disagree_by_a_part_in_a_thousand_million",
    ),
    (
        "models/growth/constrained.py",
        "SOLVABILITY_TOLERANCE = 1e-9",
        "SOLVABILITY_TOLERANCE = 1e-10",
        "tests/models/growth/test_constrained.py::test_dependent_rows_may_disagree_by_a_part_in_a_thousand_million",
    ),
    (
        "steppers/stages/compiled_operations.py",
        "((r * n - d) + r",
        "(r",
        "tests/steppers/test_flights.py::test_great_circles_end_on_the_sphere_wherever_they_start",
    ),
    (
        "models/growth/model.py",
        "self.alpha1 / self.beta1])",
        "self.alpha1 / self.beta2])",
        "tests/models/growth/test_models.py::test_lotka_volterra_with_four_different_parameters",
    ),
    (
        "models/growth/rows.py",
        'return -float(called(f"time der',
        'return float(called(f"time der',
        "tests/models/growth/test_constrained.py::test_values_stay_along_the_velocity_of_the_rows",
    ),
    (
        "models/growth/rows.py",
        "lambda t, x: -self._moved(t)[1]",
        "lambda t, x: self._moved(t)[1]",
        "tests/models/growth/test_constrained.py::test_values_stay_along_the_velocity_of_the_rows",
    ),
    (
        "models/flows/known_flows.py",
        "complex(-0.5 * (self.eta + a))",
        "complex(-0.5 * (self.eta - a))",
        "tests/models/flows/test_known_flows.py::test_damped_oscillator_reference",
    ),
    (
        "models/flows/known_flows.py",
        "complex(-0.5 * (self.eta + a))",
        "complex(0.5 * (self.eta + a))",
        "tests/models/flows/test_known_flows.py::test_damped_oscillator_reference",
    ),
    (
        "models/flows/known_flows.py",
        "self.omega * (self.omega / first))",
        "0.5 * (a - self.eta))",
        "tests/models/flows/test_known_flows.py::test_oscillator_eigenvalues_to_the_last_digits",
    ),
    (
        "models/flows/known_flows.py",
        "[[second / self.omega, first / self.omega]",
        "[[first / self.omega, second / self.omega]",
        "tests/models/flows/test_known_flows.py::test_jordan_form_of_the_oscillator",
    ),
    (
        "models/flows/linear.py",
        "size * EPSILON * np.linalg.norm(block * ratio)",
        "0.0",
        "tests/models/flows/test_linear.py::test_errors_hold_and_are_not_much_too_large",
    ),
    (
        "models/flows/linear.py",
        "np.all(real > off)",
        "np.all(real > 0)",
        "tests/models/flows/test_linear.py::test_what_is_said_is_so",
    ),
    (
        "models/flows/linear.py",
        "certain = closer == 1.0 and kept",
        "certain = kept",
        "tests/models/flows/test_linear.py::test_neighbours_that_rounding_joins_are_told_as_uncertain",
    ),
    (
        "models/flows/mechanics.py",
        "np.concatenate([slope[self.f :], -slope[: self.f]])",
        "np.concatenate([slope[self.f :], slope[: self.f]])",
        "tests/models/flows/test_mechanics.py::test_friction_by_a_hamiltonian_that_depends_on_time",
    ),
    (
        "constraints/projection.py",
        "rtol)].conj().T)",
        "rtol)].T)",
        "tests/constraints/test_projection.py::test_complex_matrices",
    ),
    # -- multibody systems --
    (
        "models/multibody.py",
        "self.N.T @ (f - self.M @ a)",
        "self.N.T @ f",
        "tests/models/test_multibody.py::test_one_place_against_the_theory "
        "tests/models/test_multibody.py::test_a_linear_change_of_coordinates_changes_nothing",
    ),
    (
        "models/multibody.py",
        "left[rank - 1] > DEPENDENT * left[0]",
        "left[rank - 1] > 0.0",
        "tests/models/test_multibody.py::test_a_crossing_of_two_ways_is_passed_straight_on",
    ),
    (
        "models/integration.py",
        "        told.clear()\n",
        "        pass\n",
        "tests/models/test_multibody.py::test_what_ends_a_run_is_told_not_what_was_got_over",
    ),
    (
        "models/multibody.py",
        "for _ in range(ITERATIONS):",
        "for _ in range(1):",
        "tests/models/test_multibody.py::test_a_start_off_the_constraints_is_refused_and_can_be_mended",
    ),
    (
        "models/multibody.py",
        "self._g(q + s * v, t + s), 0.0",
        "self._g(q + s * v, t), 0.0",
        "tests/models/test_multibody.py::test_constraints_that_move",
    ),
    (
        "models/integration.py",
        "self.D[0] += y - self.y",
        "pass",
        "tests/models/test_integration.py::test_the_next_step_starts_from_the_projection",
    ),
    (
        "solvers/sparse/rows_at_once.py",
        "_from(p, stride * i)",
        "_from(p, 0 * i)",
        "tests/solvers/sparse/test_rows_at_once.py::test_values_and_gradients_are_those_of_one_row",
    ),
    (
        "solvers/sparse/row_functions.py",
        "alike[first + size - 1] = True",
        "alike[:] = True",
        "tests/solvers/sparse/test_rows_at_once.py::test_who_is_called_one_by_one",
    ),
    (
        "solvers/sparse/row_functions.py",
        "and before[1] == time and before[2] == value:",
        "and before[1] == time:",
        "tests/solvers/sparse/test_row_functions.py::test_a_gradient_is_found_again_where_the_value_has_changed",
    ),
]
