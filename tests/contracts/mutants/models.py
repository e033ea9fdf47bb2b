"""Mutants of growth, flows, notes and multibody systems."""

MUTANTS = {
    "models/growth/constrained.py": {
        "and «all(row.moving for row in equal)→False»:": "contracts/refusals",
        "for _ in range(«2→1» if k else 0):": "constrained::nearly_parallel_rows_stay_orthogonal",
        "LOST = 1e-1«2→1»": "constrained::rows_count_as_dependent_below_a_part_in_a_million_million",
        "LOST = 1e-1«2→3»": "constrained::rows_count_as_dependent_below_a_part_in_a_million_million",
        "Y_TOLERANCE = 1e-«9→8»": "constrained::dependent_rows_may_disagree_by_a_part_in_a_thousand_million",
        "Y_TOLERANCE = 1e-«9→10»": "constrained::dependent_rows_may_disagree_by_a_part_in_a_thousand_million",
    },
    "steppers/compiled_operations.py": {
        "(«(r * n - d) + →»r": "schemes::great_circles_end_on_the_sphere_wherever_they_start",
    },
    "models/growth/model.py": {
        "self.alpha1 / self.beta«1→2»])": "models::lotka_volterra_with_four_different_parameters",
        'return «-→»float(called(f"time der': "constrained::values_stay_along_the_velocity_of_the_rows",
        "lambda t, x: «-→»moved(t)[1]": "constrained::values_stay_along_the_velocity_of_the_rows",
    },
    "models/flows/known_flows.py": {
        "complex(-0.5 * (self.eta «+→-» a))": "known_flows::damped_oscillator_reference",
        "complex(«-→»0.5 * (self.eta + a))": "known_flows::damped_oscillator_reference",
        "«self.omega * (self.omega / first→0.5 * (a - self.eta»))": (
            "known_flows::oscillator_eigenvalues_to_the_last_digits"
        ),
        "[[«second / self.omega, first→first / self.omega, second» /": "known_flows::jordan_form_of_the_oscillator",
    },
    "models/flows/linear.py": {
        "«len(A) * EPSILON * float(np.linalg.norm(balanced))→0.0»": "linear::errors_hold_and_are_not_much_too_large",
        "np.all(real > «off→0»)": "linear::what_is_said_is_so",
        "«p.quo(common) * →»once": "linear::eigenvalues_on_the_axis_are_counted_in_integers",
        "certain = «closer == 1.0 and →»bool(kept": "linear::neighbors_that_rounding_joins_are_told_as_uncertain",
    },
    "models/flows/flow.py": {
        "        «flow._check_jacobian(b, state)→pass»\n": "contracts/refusals",
        "concatenate([slope[self.f :], «-→»slope[: self": "flow::equations_by_differences",
    },
    "constraints/projection.py": {
        "vt[kept].«conj().→»T)": "constraints/projection::complex_matrices",
    },
    "models/multibody.py": {
        "self.N.T @ «(f - self.M @ a)→f»": "multibody::one_place_against_the_theory",
        "left[rank - 1] > «DEPENDENT * left[0]→0.0»": "multibody::a_crossing_of_two_ways_is_passed_straight_on",
        "if «not off <= accepted→False»:": "multibody::positions_that_cannot_be_met",
        "for _ in range(«ITERATIONS→1»):": "multibody::a_start_off_the_constraints_is_refused_and_can_be_mended",
    },
    "models/integration.py": {
        "        «told.clear()→pass»": "multibody::what_ends_a_run_is_told_not_what_was_got_over",
        "«self.D[0] += y - self.y→pass»": "integration::the_next_step_starts_from_the_projection",
    },
    "solvers/sparse/row_functions.py": {
        "_from(p, «stride→0» * i)": "single_rows::solutions_are_those_of_rows_called_one_by_one",
        "alike[«first + size - 1→:»] = True": "single_rows::who_is_called_one_by_one",
        "] == here« and before[1] == value→»": "row_functions::a_gradient_is_found_again_where_the_value_has_changed",
    },
}
