"""Mutants of the solvers."""

MUTANTS = [
    # -- compiled kernels and formulas --
    (
        "constraints/compilation.py",
        "function.linkage = llvm.Linkage.internal",
        "function.linkage = llvm.Linkage.linkonce_odr",
        "tests/constraints/test_compilation.py::test_a_kernel_calls_its_own_copies_of_others",
    ),
    (
        "constraints/compilation.py",
        "if text == _headed(content):",
        "if text:",
        "tests/constraints/test_compilation.py::test_damaged_files_are_made_anew_and_said_once",
    ),
    (
        "constraints/functions/expressions.py",
        "    what = undefined_part(tree, known)\n",
        "    what = None\n",
        "tests/constraints/functions/test_expressions.py::test_formulas_without_bound_are_refused_at_once",
    ),
    (
        "constraints/functions/expressions.py",
        'sympy.Symbol(f"sign of {inner}")',
        "sympy.S.NegativeOne",
        "tests/constraints/functions/test_expressions.py::test_shifts_are_found_out_where_multiplying_out_has_no_end",
    ),
    # -- any rows --
    (
        "solvers/tolerances.py",
        "DENSE_SPEED_TOLERANCE = 1e-11",
        "DENSE_SPEED_TOLERANCE = 1e-7",
        "tests/solvers/test_general_clusters.py::test_velocities_that_cannot_be_tangent_are_refused",
    ),
    (
        "solvers/general_clusters.py",
        "np.maximum(ROUNDING, 2 * EPS",
        "np.maximum(1e-10, 2 * EPS",
        "tests/solvers/test_general_clusters.py::test_no_more_is_left_than_rounding",
    ),
    (
        "solvers/general_clusters.py",
        "2 * EPS * reach / self._scale",
        "2e4 * EPS * reach / self._scale",
        "tests/solvers/test_general_clusters.py::test_no_more_is_left_than_rounding",
    ),
    (
        "solvers/general_clusters.py",
        '(np.einsum("nkc,nkc->nk", b, b0) > least)',
        '(np.einsum("nkc,nkc->nk", b, b0) > -np.inf)',
        "tests/solvers/test_general_clusters.py::test_the_other_side_is_no_solution",
    ),
    (
        "solvers/general_clusters.py",
        "taken += ~done",
        "taken += 1",
        "tests/solvers/test_general_clusters.py::test_what_many_iterations_ask_for_is_asked_of_the_clusters_that_took_them",
    ),
    (
        "solvers/general_clusters.py",
        'wanted = wanted - np.einsum("nkc,nc->nk", gradient,',
        'wanted = wanted + np.einsum("nkc,nc->nk", gradient,',
        "tests/solvers/test_general_clusters.py::test_atoms_of_infinite_mass_move_as_prescribed",
    ),
    # -- distances of any connection --
    (
        "solvers/tolerances.py",
        "NEWTON_TOLERANCE = 4e-15",
        "NEWTON_TOLERANCE = 4e-11",
        "tests/solvers/test_distance_solvers.py::test_matches_dense_newton[sparse-comb]",
    ),
    (
        "solvers/sparse/distances.py",
        "if i == j2:\n                total -= w[i]",
        "if i == j2:\n                total += w[i]",
        "tests/solvers/test_distance_solvers.py::test_matches_dense_newton[sparse-comb]",
    ),
    (
        "solvers/sparse/distances.py",
        "second_vector(state, 8 * k)) > 0.0):",
        "second_vector(state, 8 * k)) > -1e300):",
        "tests/solvers/test_distance_solvers.py::test_failure_changes_nothing_and_names_the_cluster[turned-sparse-methane]",
    ),
    (
        "solvers/sparse/distances.py",
        "goal = number(rates, k) * np.sqrt(s2) if driven",
        "goal = number(rates, k) * s2 if driven",
        "tests/solvers/test_distance_solvers.py::test_tangents_match_dense_solve[True-sparse-comb]",
    ),
    # -- eight small clusters at once --
    (
        "solvers/small_clusters.py",
        "kept = kept and all_within(TINY, inner)",
        "kept = kept and all_within(-1e300, inner)",
        "tests/solvers/test_distance_solvers.py::test_failure_changes_nothing_and_names_the_cluster[turned-small-bond]",
    ),
    (
        "solvers/small_clusters.py",
        "kept_points, n_local)\n",
        "kept_points, 0)\n",
        "tests/solvers/test_distance_solvers.py::test_failure_changes_nothing_and_names_the_cluster[far-small-bond]",
    ),
    (
        "solvers/small_clusters.py",
        "rate = rate * square_root(square)",
        "rate = rate * square",
        "tests/solvers/test_distance_solvers.py::test_tangents_match_dense_solve[True-small-bond]",
    ),
    # -- triangles --
    (
        "solvers/rigid_triangles.py",
        "all_within(TINY, ps) and all_within(TINY, qt) and all_within(TINY, us)",
        "all_within(TINY, ps) and all_within(TINY, qt)",
        "tests/solvers/test_distance_solvers.py::test_a_third_side_that_turned_round_is_no_solution",
    ),
    (
        "solvers/rigid_triangles.py",
        "c10, c11, c12 = -(a12 * a20 + a10 * a22)",
        "c10, c11, c12 = -(a12 * a20 - a10 * a22)",
        "tests/solvers/test_distance_solvers.py::test_newton_and_a_chord_step_gain_together",
    ),
    (
        "solvers/rigid_triangles.py",
        "restore_points(velocities, atoms, undo, group, 3, kept_points, 3)",
        "restore_points(velocities, atoms, undo, group, 3, kept_points, 0)",
        "tests/solvers/test_distance_solvers.py::test_failure_changes_nothing_and_names_the_cluster[far-triangles-29]",
    ),
    # -- chains --
    (
        "solvers/chains/sweeps.py",
        "vx, vy, vz = vx - dx * inverse_dt, vy - dy * inverse_dt, vz - dz * inverse_dt",
        "vx, vy, vz = vx - dx * inverse_dt, vy - dy * inverse_dt, vz - dz",
        "tests/solvers/test_distance_solvers.py::test_matches_dense_newton[chains-short-free]",
    ),
    (
        "solvers/chains/sweeps.py",
        "dx = dx - w * (sx * later - px * later_p)",
        "dx = dx - w * (sx * later)",
        "tests/solvers/test_distance_solvers.py::test_ten_thousand_bonds[straight]",
    ),
    (
        "solvers/chains/sweeps.py",
        "rx + real * (gx - fx)",
        "rx + real * (gx + fx)",
        "tests/solvers/test_distance_solvers.py::test_ten_thousand_bonds[free]",
    ),
    # -- rows of several kinds --
    (
        "solvers/sparse/mixed_rows.py",
        "if abs(d) > PIVOT_TOLERANCE * abs(whole) else 0.0",
        "if abs(d) > 0.0 else 0.0",
        "tests/solvers/sparse/test_mixed_rows.py::test_dependent_rows_are_dropped",
    ),
    (
        "solvers/sparse/mixed_rows.py",
        "if not (along > 0.0) and",
        "if not (along > -1e300) and",
        "tests/solvers/sparse/test_mixed_rows.py"
        "::test_a_molecule_turned_through_a_point_is_no_solution_though_its_rows_hold",
    ),
    (
        "solvers/sparse/row_values.py",
        "r = (here - load_quad(moved, 4 * p)) + change",
        "r = here + change",
        "tests/solvers/sparse/test_row_values.py::test_rows_with_a_place_take_off_what_positions_were_moved_by",
    ),
    (
        "motion/restoring/nearest_point.py",
        "here = mixed.after(here, ahead)",
        "here = ahead",
        "tests/motion/restoring/test_nearest_point.py::test_the_nearest_point_is_found_where_the_surface_is_much_bent",
    ),
    (
        "solvers/sparse/row_values.py",
        "difference -= period * np.rint(difference / period)",
        "difference -= 0.5 * period * np.rint(2 * difference / period)",
        "tests/solvers/sparse/test_row_values.py::test_rows_with_a_period_miss_by_the_shorter_way",
    ),
    (
        "constraints/internal.py",
        "hb = (hx * gx + hy * gy + hz * gz) / (b2 * size)",
        "hb = -(hx * gx + hy * gy + hz * gz) / (b2 * size)",
        "tests/constraints/test_constraint.py::test_gradient_and_curvature_by_taylor_remainder[Dihedral-0]",
    ),
    (
        "solvers/sparse/row_values.py",
        "y -= a * cell[0][1] + b * cell[1][1] + c * cell[2][1]",
        "y -= a * cell[0][1] + b * cell[1][1]",
        "tests/solvers/sparse/test_row_values.py::test_rows_equal_their_constraints",
    ),
    # -- functions --
    (
        "solvers/called_solvers.py",
        "_call_apply(words[k + 2], (v, inv_dt, mine))",
        "_call_apply(words[k + 2], (v, 1.0, mine))",
        "tests/solvers/test_called_solvers.py::test_the_same_as_from_python",
    ),
    (
        "constraints/surface.py",
        "f, g = h / (rho * q), up / q",
        "f, g = h / rho, up / q",
        "tests/constraints/test_constraint.py::test_gradient_and_curvature_by_taylor_remainder[Torus-0]",
    ),
    (
        "solvers/sparse/row_functions.py",
        "if np.all(table == table[0]):",
        "if np.any(table == table[0]):",
        "tests/solvers/test_single_rows.py::test_rows_agree_with_the_dense_solver[Sphere-open]",
    ),
    (
        "solvers/single_rows.py",
        "put(solution, k, last + 0.5 * (lam - last))",
        "put(solution, k, lam)",
        "tests/solvers/test_single_rows.py::test_steps_that_overshoot_are_halved",
    ),
    (
        "solvers/single_rows.py",
        "slope < FLAT * size",
        "slope < 0.0 * size",
        "tests/solvers/test_single_rows.py::test_a_dihedral_that_turns_over_has_no_solution_far_away",
    ),
    (
        "constraints/functions/expressions.py",
        "second = [bend, value.diff(t), 2 * along.diff(t) + value.diff(t, 2)]",
        "second = [bend, value.diff(t), along.diff(t) + value.diff(t, 2)]",
        "tests/constraints/test_constraint_set.py::test_acceleration_target_is_the_second_derivative_along_any_curve",
    ),
    # -- numbers several doubles wide --
    (
        "solvers/kernels/eight_wide.py",
        '_EIGHT.all_true(builder, builder.fcmp_ordered("<=", value, limit))',
        '_EIGHT.all_true(builder, builder.fcmp_unordered("<=", value, limit))',
        "tests/solvers/test_distance_solvers.py::test_failure_changes_nothing_and_names_the_cluster[nan-small-bond]",
    ),
    (
        "solvers/kernels/two_and_four_wide.py",
        "total = builder.fadd(builder.load(front, align=8), shuffle(builder, value, value, [0, 1]), flags=FLAGS)",
        "total = builder.fadd(builder.load(front, align=8), shuffle(builder, value, value, [0, 0]), flags=FLAGS)",
        "tests/solvers/test_distance_solvers.py::test_matches_dense_newton[sparse-comb]",
    ),
]
