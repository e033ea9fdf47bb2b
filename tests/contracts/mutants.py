"""Single lines of the package made wrong, and the tests that must notice.

An entry is (file in kcons/, its text, the wrong text, tests that must fail). The text occurs once in the file. Names of
tests are those that pytest takes, several parted by blanks; parameters in brackets are left out where any will do.
"""

MUTANTS = [
    # -- solvers: any rows --
    (
        "solvers/general.py",
        "SPEED_TOLERANCE = 1e-11",
        "SPEED_TOLERANCE = 1e-7",
        "tests/solvers/test_general.py::test_velocities_that_cannot_be_tangent_are_refused",
    ),
    (
        "solvers/general.py",
        "np.maximum(1e-14, 2 * _EPS",
        "np.maximum(1e-10, 2 * _EPS",
        "tests/solvers/test_general.py::test_no_more_is_left_than_rounding",
    ),
    (
        "solvers/general.py",
        "2 * _EPS * reach / self._scale",
        "2e4 * _EPS * reach / self._scale",
        "tests/solvers/test_general.py::test_no_more_is_left_than_rounding",
    ),
    (
        "solvers/general.py",
        '(np.einsum("nkc,nkc->nk", b, b0) > 0)',
        '(np.einsum("nkc,nkc->nk", b, b0) > -np.inf)',
        "tests/solvers/test_general.py::test_the_other_side_is_no_solution",
    ),
    (
        "solvers/general.py",
        'wanted = wanted - np.einsum("nkc,nc->nk", gradient,',
        'wanted = wanted + np.einsum("nkc,nc->nk", gradient,',
        "tests/solvers/test_general.py::test_atoms_of_infinite_mass_move_as_prescribed",
    ),
    # -- solvers: distances of any connection --
    (
        "solvers/distances.py",
        "LENGTH_TOLERANCE = 4e-15",
        "LENGTH_TOLERANCE = 4e-11",
        "tests/solvers/test_distances.py::test_matches_dense_newton[comb]",
    ),
    (
        "solvers/distances.py",
        "if i == j2:\n                total -= w[i]",
        "if i == j2:\n                total += w[i]",
        "tests/solvers/test_distances.py::test_matches_dense_newton[comb]",
    ),
    (
        "solvers/distances.py",
        "second_vector(state, 8 * k)) > 0.0):",
        "second_vector(state, 8 * k)) > -1e300):",
        "tests/solvers/test_distances.py::test_failure_changes_nothing_and_names_the_cluster[flipped]",
    ),
    (
        "solvers/distances.py",
        "goal = number(rates, k) * np.sqrt(s2) if driven",
        "goal = number(rates, k) * s2 if driven",
        "tests/solvers/test_distances.py::test_tangents_match_dense_solve[True-comb]",
    ),
    # -- solvers: eight small clusters at once --
    (
        "solvers/lanes.py",
        "kept = kept and all_within(TINY, dot(x, y, z, a, b, c))",
        "kept = kept and all_within(-1e300, dot(x, y, z, a, b, c))",
        "tests/solvers/test_lanes.py::test_failure_changes_nothing_and_names_the_cluster[bond-flipped]",
    ),
    (
        "solvers/lanes.py",
        "2 * n_local, n_local)\n",
        "2 * n_local, 0)\n",
        "tests/solvers/test_lanes.py::test_failure_changes_nothing_and_names_the_cluster[bond-far]",
    ),
    (
        "solvers/lanes.py",
        "rate = rate * square_root(square)",
        "rate = rate * square",
        "tests/solvers/test_lanes.py::test_tangents_match_dense_solve[True-bond]",
    ),
    # -- solvers: triangles --
    (
        "solvers/water.py",
        "kept = all_within(TINY, ps) and all_within(TINY, qt) and all_within(TINY, us)",
        "kept = all_within(TINY, ps) and all_within(TINY, qt)",
        "tests/solvers/test_water.py::test_a_third_side_that_turned_round_is_no_solution",
    ),
    (
        "solvers/water.py",
        "c10, c11, c12 = -(a12 * a20 + a10 * a22)",
        "c10, c11, c12 = -(a12 * a20 - a10 * a22)",
        "tests/solvers/test_water.py::test_newton_and_a_chord_step_gain_together",
    ),
    (
        "solvers/water.py",
        "restore_points(velocities, atoms, undo, group, 3, 6, 3)",
        "restore_points(velocities, atoms, undo, group, 3, 6, 0)",
        "tests/solvers/test_water.py::test_failure_changes_nothing_and_names_the_triangle[far]",
    ),
    # -- solvers: chains --
    (
        "solvers/sweeps.py",
        "vx, vy, vz = vx - dx * inverse_dt, vy - dy * inverse_dt, vz - dz * inverse_dt",
        "vx, vy, vz = vx - dx * inverse_dt, vy - dy * inverse_dt, vz - dz",
        "tests/solvers/test_chain.py::test_matches_dense_newton[short-free]",
    ),
    (
        "solvers/sweeps.py",
        "dx = dx - w * (sx * later - px * later_p)",
        "dx = dx - w * (sx * later)",
        "tests/solvers/test_chain.py::test_ten_thousand_bonds[straight]",
    ),
    (
        "solvers/sweeps.py",
        "rx + real * (gx - fx)",
        "rx + real * (gx + fx)",
        "tests/solvers/test_chain.py::test_ten_thousand_bonds[free]",
    ),
    # -- solvers: rows of several kinds --
    (
        "solvers/rows.py",
        "if abs(d) > PIVOT_TOLERANCE * abs(whole) else 0.0",
        "if abs(d) > 0.0 else 0.0",
        "tests/solvers/test_rows.py::test_dependent_rows_are_dropped",
    ),
    (
        "solvers/rows.py",
        "if not (along > 0.0):",
        "if not (along > -1e300):",
        "tests/solvers/test_rows.py::test_failure_changes_nothing[flipped]",
    ),
    (
        "solvers/coordinates.py",
        "difference -= 2 * np.pi * np.rint(difference / (2 * np.pi))",
        "difference -= np.pi * np.rint(difference / np.pi)",
        "tests/solvers/test_coordinates.py::test_dihedrals_miss_by_the_shorter_way",
    ),
    (
        "solvers/coordinates.py",
        "hb = (hx * gx + hy * gy + hz * gz) / (b2 * size)",
        "hb = -(hx * gx + hy * gy + hz * gz) / (b2 * size)",
        "tests/solvers/test_coordinates.py::test_rows_equal_their_constraints",
    ),
    (
        "solvers/coordinates.py",
        "y -= a * cell[0][1] + b * cell[1][1] + c * cell[2][1]",
        "y -= a * cell[0][1] + b * cell[1][1]",
        "tests/solvers/test_coordinates.py::test_rows_equal_their_constraints",
    ),
    # -- solvers: numbers several doubles wide --
    (
        "solvers/simd.py",
        'bits = _reduced(builder, builder.fcmp_ordered("<=", value, limit))',
        'bits = _reduced(builder, builder.fcmp_unordered("<=", value, limit))',
        "tests/solvers/test_lanes.py::test_failure_changes_nothing_and_names_the_cluster[bond-nan]",
    ),
    (
        "solvers/narrow.py",
        "total = builder.fadd(builder.load(front, align=8), _shuffle(builder, args[2], args[2], [0, 1]), flags=_FLAGS)",
        "total = builder.fadd(builder.load(front, align=8), _shuffle(builder, args[2], args[2], [0, 0]), flags=_FLAGS)",
        "tests/solvers/test_distances.py::test_matches_dense_newton[comb]",
    ),
    # -- programs for OpenMM --
    (
        "openmm/steps.py",
        'p.let("good_steps", "good_steps+delta(failed)", "count it")',
        'p.let("good_steps", "good_steps+1", "count it")',
        "tests/openmm/test_steps.py::test_a_step_whose_last_projection_fails_is_not_counted",
    ),
    (
        "openmm/steps.py",
        'p.each("x", "x_last", "back to where the step began")',
        'p.each("x", "x", "back to where the step began")',
        "tests/openmm/test_collective.py::test_a_step_too_large_is_taken_back",
    ),
    (
        "openmm/steps.py",
        'p.each("v", "v_last", "back to where the step began")',
        'p.each("v", "v", "back to where the step began")',
        "tests/openmm/test_collective.py::test_a_step_too_large_is_taken_back",
    ),
    (
        "openmm/steps.py",
        "u=v+0.5*dt*f/m+0.5*impulse",
        "u=v+0.5*dt*f/m",
        "tests/openmm/test_lean_steps.py::test_leapfrog_at_rest_has_no_kinetic_energy",
    ),
    (
        "openmm/lean_steps.py",
        '"select(looked, v_last, u-0.5*dt*f/m)"',
        '"v_last"',
        "tests/openmm/test_lean_steps.py::test_failure_where_nobody_looked",
    ),
    (
        "openmm/langevin.py",
        "sqrt(2*kT*kept_share*sinh(friction*dt))",
        "sqrt(kT*kept_share*sinh(friction*dt))",
        "tests/openmm/test_langevin_ensemble.py",
    ),
    (
        "openmm/row_algebra.py",
        "{self.inverse(i, j)}+weight{c}*(more{c}_{i}-expected{c}_{i})*left{c}_{j}",
        "{self.inverse(i, j)}+weight{c}*(more{c}_{i}+expected{c}_{i})*left{c}_{j}",
        "tests/openmm/test_row_algebra.py",
    ),
    (
        "openmm/row_algebra.py",
        'p.let(f"back{c}_{i}_{j}", f"-({done})*back{c}_{i}_{i}"',
        'p.let(f"back{c}_{i}_{j}", f"({done})*back{c}_{i}_{i}"',
        "tests/openmm/test_row_algebra.py",
    ),
    (
        "openmm/surface_steps.py",
        '"select(behind, 1, kick_share(first_stage))"',
        '"kick_share(first_stage)"',
        "tests/openmm/test_surface_motion.py",
    ),
    (
        "openmm/surface_steps.py",
        '"select(failed, 0.5*behind, kick_share(stage))"',
        '"kick_share(stage)"',
        "tests/openmm/test_surface.py::test_a_first_step_without_solution_leaves_velocities_without_a_kick",
    ),
    (
        "openmm/schemes.py",
        "first = 0 if scheme.kick_first else every",
        "first = 0",
        "tests/openmm/test_accuracy.py",
    ),
    (
        "openmm/carrier.py",
        "return self.motion.rank - 3 * fixed",
        "return self.motion.rank",
        "tests/openmm/test_carrier.py::test_particles_without_mass_take_no_degree_of_freedom",
    ),
    # -- growth, flows, notes --
    (
        "growth/orthogonal_rows.py",
        "                q -= again * units[j]",
        "                pass",
        "tests/growth/test_orthogonal_rows.py::test_nearly_parallel_rows_stay_orthogonal",
    ),
    (
        "growth/orthogonal_rows.py",
        "RANK_TOLERANCE = 1e-12",
        "RANK_TOLERANCE = 1e-11",
        "tests/growth/test_orthogonal_rows.py::test_rows_count_as_dependent_below_a_part_in_a_million_million",
    ),
    (
        "growth/orthogonal_rows.py",
        "RANK_TOLERANCE = 1e-12",
        "RANK_TOLERANCE = 1e-13",
        "tests/growth/test_orthogonal_rows.py::test_rows_count_as_dependent_below_a_part_in_a_million_million",
    ),
    (
        "growth/orthogonal_rows.py",
        "SOLVABILITY_TOLERANCE = 1e-9",
        "SOLVABILITY_TOLERANCE = 1e-8",
        "tests/growth/test_orthogonal_rows.py::test_dependent_rows_may_disagree_by_a_part_in_a_thousand_million",
    ),
    (
        "growth/orthogonal_rows.py",
        "SOLVABILITY_TOLERANCE = 1e-9",
        "SOLVABILITY_TOLERANCE = 1e-10",
        "tests/growth/test_orthogonal_rows.py::test_dependent_rows_may_disagree_by_a_part_in_a_thousand_million",
    ),
    (
        "steppers/drifts.py",
        "((self.radii * n - d) + self.radii",
        "(self.radii",
        "tests/steppers/test_drifts.py::test_great_circles_end_on_the_sphere_wherever_they_start",
    ),
    (
        "growth/models.py",
        "self.alpha1 / self.beta1])",
        "self.alpha1 / self.beta2])",
        "tests/growth/test_models.py::test_lotka_volterra_with_four_different_parameters",
    ),
    (
        "growth/rows.py",
        "return -evaluate(self._time",
        "return evaluate(self._time",
        "tests/growth/test_constrained.py::test_values_stay_along_the_velocity_of_the_rows",
    ),
    (
        "growth/rows.py",
        "return self._moved(p, 1) if",
        "return -self._moved(p, 1) if",
        "tests/growth/test_constrained.py::test_values_stay_along_the_velocity_of_the_rows",
    ),
    (
        "flows/models.py",
        "complex(-0.5 * (self.eta + a))",
        "complex(-0.5 * (self.eta - a))",
        "tests/flows/test_models.py::test_damped_oscillator_reference",
    ),
    (
        "flows/models.py",
        "complex(-0.5 * (self.eta + a))",
        "complex(0.5 * (self.eta + a))",
        "tests/flows/test_models.py::test_damped_oscillator_reference",
    ),
    (
        "flows/models.py",
        "self.omega * (self.omega / first))",
        "0.5 * (a - self.eta))",
        "tests/flows/test_models.py::test_oscillator_eigenvalues_to_the_last_digits",
    ),
    (
        "flows/models.py",
        "[[second / self.omega, first / self.omega]",
        "[[first / self.omega, second / self.omega]",
        "tests/flows/test_models.py::test_jordan_form_of_the_oscillator",
    ),
    (
        "flows/spectrum.py",
        "size * EPSILON * np.linalg.norm(block * ratio)",
        "0.0",
        "tests/flows/test_spectrum.py::test_errors_hold_and_are_not_much_too_large",
    ),
    (
        "flows/stability.py",
        "np.all(real > off)",
        "np.all(real > 0)",
        "tests/flows/test_stability.py::test_what_is_said_is_so",
    ),
    (
        "flows/jordan.py",
        "certain = closer == 1.0 and kept",
        "certain = kept",
        "tests/flows/test_jordan.py::test_neighbours_that_rounding_joins_are_told_as_uncertain",
    ),
    (
        "flows/hamiltonian.py",
        "t + GAUSS_C[k] * dt",
        "t",
        "tests/flows/test_hamiltonian.py::test_order_where_the_hamiltonian_depends_on_time",
    ),
    ("projection.py", "rtol)].conj().T)", "rtol)].T)", "tests/test_projection.py::test_complex_matrices"),
    # -- steppers, thermostats, arrays --
    (
        "motion.py",
        "np.copyto(velocities, saved[1])",
        "pass",
        "tests/test_motion.py::test_velocities_are_put_back_when_a_later_solver_fails",
    ),
    (
        "steppers/drifts.py",
        "self.motion.project_positions(out, point.x, time=end, reference_time=start,",
        "self.motion.project_positions(out, point.x, time=end, reference_time=end,",
        "tests/steppers/test_drifts.py::test_impulses_act_along_the_gradients_of_the_time_of_the_start",
    ),
    (
        "steppers/drifts.py",
        "self.motion.project_positions(out, x, time=end, reference_time=start,",
        "self.motion.project_positions(out, x, time=end, reference_time=end,",
        "tests/steppers/test_drifts.py::test_impulses_act_along_the_gradients_of_the_time_of_the_start",
    ),
    (
        "steppers/drifts.py",
        "self.held.jacobian(x0, start)",
        "self.held.jacobian(x0, end)",
        "tests/steppers/test_drifts.py::test_impulses_act_along_the_gradients_of_the_time_of_the_start",
    ),
    (
        "steppers/drifts.py",
        "0.5 * (start + end)",
        "start",
        "tests/steppers/test_drifts.py::test_driven_velocities_hold_at_the_middle_of_the_time",
    ),
    (
        "steppers/drifts.py",
        "0.5 * (start + end)",
        "start + 0.5 * h",
        "tests/steppers/test_friction.py::test_rows_of_velocities_keep_order_and_way_back",
    ),
    (
        "thermostats/langevin.py",
        "end if k == count else start + k * (end - start) / count",
        "end",
        "tests/thermostats/test_langevin.py::test_each_substep_meets_targets_at_its_own_time",
    ),
    (
        "thermostats/nose_hoover.py",
        "q[0] *= count",
        "q[0] *= 1.0",
        "tests/thermostats/test_nose_hoover.py::test_temperature_oscillates_with_the_period_asked_for",
    ),
    (
        "steppers/drifts.py",
        "before = float(np.abs(kicked[self.atoms]).max())",
        "before = 0.0",
        "tests/steppers/test_coming_to_rest.py::test_a_blade_takes_up_a_kick_from_the_side_whole",
    ),
    (
        "steppers/splitting.py",
        "size = max(start, float(np.abs(push).max(initial=0.0)), float(np.abs(v).max(initial=0.0)))",
        "size = float(np.abs(v).max(initial=0.0))",
        "tests/steppers/test_coming_to_rest.py::test_a_damped_pendulum_comes_to_rest",
    ),
    (
        "steppers/splitting.py",
        "change <= 2 * _EPS * size",
        "change <= 1e8 * _EPS * size",
        "tests/steppers/test_coming_to_rest.py::test_settled_velocities_are_those_of_the_implicit_equation",
    ),
    (
        "steppers/splitting.py",
        "_WHOLE, friction.flight(h), out",
        "_WHOLE, h, out",
        "tests/steppers/test_friction.py::test_a_body_sinks_as_fast_as_it_should_however_strong_the_friction",
    ),
    (
        "steppers/splitting.py",
        "whole = step.exact and (system.friction is None or system.friction.uniform)",
        "whole = step.exact",
        "tests/steppers/test_friction.py::test_spheres_at_different_rates_keep_high_orders",
    ),
    (
        "steppers/state.py",
        "if count != len(archive.namelist()):",
        "if False:",
        "tests/steppers/test_state.py::test_a_damaged_byte_is_noticed",
    ),
    (
        "files.py",
        "unfinished.unlink(missing_ok=True)",
        "pass",
        "tests/steppers/test_state.py::test_a_full_disk_leaves_nothing_behind",
    ),
    (
        "arrays.py",
        'if array.dtype.kind == "c":',
        "if False:",
        "tests/test_arrays.py::test_what_is_no_real_number_is_refused",
    ),
    # -- images and certificates --
    (
        "images.py",
        "| (self.item.kind == RowKind.LINEAR)",
        "",
        "tests/test_images.py::test_atoms_in_any_image_are_held_as_whole_ones",
    ),
    (
        "images.py",
        "_HALF = 0.5 - 1e-9",
        "_HALF = 0.6",
        "tests/test_images.py::test_atoms_that_nothing_ties_raise_before_their_image_flips",
    ),
    (
        "images.py",
        "cells = np.round((y_ref - x_ref)[self.atoms] @ lattice[1]) - np.round(step @ lattice[1])",
        "cells = -np.round(step @ lattice[1])",
        "tests/test_images.py::test_atoms_in_any_image_are_held_as_whole_ones",
    ),
    (
        "images.py",
        "BOND_LIKE = 1.5",
        "BOND_LIKE = 0.5",
        "tests/test_images.py::test_a_polymer_that_closes_through_the_boundary",
    ),
    ("rank.py", "late[rows[order]] = left_over", "pass", "tests/test_plan.py::test_dependent_rows_are_eliminated_last"),
    (
        "certificate.py",
        "SPEED = 1e-9",
        "SPEED = 1.0",
        "tests/test_certificate.py::test_a_solver_that_is_wrong_without_knowing_is_found_in_the_first_step",
    ),
    (
        "motion.py",
        "            certify(self._given, here, speed, time, slack=10 * MISFIT)",
        "            pass",
        "tests/test_certificate.py::test_rows_that_were_converted_are_looked_at_as_they_were_given",
    ),
    (
        "constraint_set.py",
        "np.maximum(1e-10 * self.scale, 8 * np.finfo(float).eps",
        "np.maximum(1e-8 * self.scale, 8 * np.finfo(float).eps",
        "tests/test_certificate.py::test_what_is_allowed_scales_with_rounding",
    ),
]
