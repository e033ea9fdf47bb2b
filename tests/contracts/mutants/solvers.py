"""Mutants of the solvers."""

MUTANTS = {
    "constraints/compilation.py": [
        (
            "function.linkage = llvm.Linkage.«internal→linkonce_odr»",
            "test_compilation.py::test_a_kernel_calls_its_own_copies_of_others",
        ),
        (
            "«except Exception:  # pickle→except ZeroDivisionError:  # pickle»",
            "test_compilation.py::test_damaged_files_are_made_anew",
        ),
    ],
    "constraints/functions/expressions.py": [
        (
            "    undefined = «undefined_part(tree, _PI)→None»\n",
            "test_expressions.py::test_formulas_without_bound_are_refused_at_once",
        ),
        (
            "lambda _, x: «next(some)→-np.ones(40)»",
            "test_expressions.py::test_shifts_are_found_out",
        ),
    ],
    "constraints/constraint.py": [
        (
            "self._bent(r + 0j, v, time + step) «+→- 0 *» changes",
            "test_constraint_set.py::test_acceleration_target_is_the_second_derivative_along_any_curve",
        ),
    ],
    "solvers/tolerances.py": [
        (
            "DENSE_SPEED_TOLERANCE = 1e-«11→7»",
            "test_general_clusters.py::test_velocities_that_cannot_be_tangent_are_refused",
        ),
        ("NEWTON_TOLERANCE = 4e-1«5→1»", "test_distance_solvers.py::test_matches_dense_newton[sparse-comb]"),
    ],
    "solvers/general_clusters.py": [
        ("np.maximum(«ROUNDING→1e-10», 2 * EPS", "test_general_clusters.py::test_no_more_is_left_than_rounding"),
        ("2«→e4» * EPS * reach / self._scale", "test_general_clusters.py::test_no_more_is_left_than_rounding"),
        (
            '(np.einsum("nkc,nkc->nk", b, b0) > «least→-np.inf»)',
            "test_general_clusters.py::test_the_other_side_is_no_solution",
        ),
        (
            "taken += «~done→1»",
            "test_general_clusters.py::test_what_many_iterations_ask_for_is_asked_of_the_clusters_that_took_them",
        ),
        (
            'wanted = wanted «-→+» np.einsum("nkc,nc->nk", gradient,',
            "test_general_clusters.py::test_atoms_of_infinite_mass_move_as_prescribed",
        ),
    ],
    "solvers/sparse/distances.py": [
        (
            "if i == j2:\n                total «-→+»= w[i]",
            "test_distance_solvers.py::test_matches_dense_newton[sparse-comb]",
        ),
        (
            "second_vector(state, 8 * k)) > «0.→-1e30»0):",
            "test_distance_solvers.py::test_failure_changes_nothing_and_names_the_cluster[turned-sparse-methane]",
        ),
        (
            "goal = load_double(rates, k) * «np.sqrt(s2)→s2» if driven",
            "test_distance_solvers.py::test_tangents_match_dense_solve[True-sparse-comb]",
        ),
    ],
    "solvers/small_clusters.py": [
        (
            "kept = kept and all_within(«TINY→-1e300», inner)",
            "test_distance_solvers.py::test_failure_changes_nothing_and_names_the_cluster[turned-small-bond]",
        ),
        (
            "kept_points, «n_local→0»)\n",
            "test_distance_solvers.py::test_failure_changes_nothing_and_names_the_cluster[far-small-bond]",
        ),
        (
            "rate = rate * square«_root(square)→»",
            "test_distance_solvers.py::test_tangents_match_dense_solve[True-small-bond]",
        ),
    ],
    "solvers/rigid_triangles.py": [
        (
            "all_within(TINY, ps) and all_within(TINY, qt)« and all_within(TINY, us)→»",
            "test_distance_solvers.py::test_a_third_side_that_turned_round_is_no_solution",
        ),
        (
            "c10, c11, c12 = -(a12 * a20 «+→-» a10 * a22)",
            "test_distance_solvers.py::test_newton_and_a_chord_step_gain_together",
        ),
        (
            "restore_points(velocities, atoms, undo, group, 3, kept_points, «3→0»)",
            "test_distance_solvers.py::test_failure_changes_nothing_and_names_the_cluster[far-triangles-29]",
        ),
    ],
    "solvers/chains/sweeps.py": [
        (
            "vx, vy, vz = vx - dx * inverse_dt, vy - dy * inverse_dt, vz - dz« * inverse_dt→»",
            "test_distance_solvers.py::test_matches_dense_newton[chains-short-free]",
        ),
        ("dx = dx - w * (sx * later« - px * later_p→»)", "test_distance_solvers.py::test_ten_thousand_bonds[straight]"),
        ("rx + real * (gx «-→+» fx)", "test_distance_solvers.py::test_ten_thousand_bonds[free]"),
    ],
    "solvers/sparse/mixed_rows.py": [
        (
            "if abs(d) > «PIVOT_TOLERANCE * abs(whole)→0.0» else 0.0",
            "test_mixed_rows.py::test_dependent_rows_are_dropped",
        ),
        (
            "if not (along > «0.→-1e30»0) and",
            "test_mixed_rows.py::test_a_molecule_turned_through_a_point_is_no_solution_though_its_rows_hold",
        ),
    ],
    "solvers/sparse/row_values.py": [
        (
            "r = «(here - load_quad(moved, 4 * p))→here» + change",
            "test_row_values.py::test_rows_with_a_place_take_off_what_positions_were_moved_by",
        ),
        (
            "difference -= «period * np.rint(→0.5 * period * np.rint(2 * »difference / period)",
            "test_row_values.py::test_rows_with_a_period_miss_by_the_shorter_way",
        ),
        (
            "y -= a * cell[0][1] + b * cell[1][1]« + c * cell[2][1]→»",
            "test_row_values.py::test_rows_equal_their_constraints",
        ),
    ],
    "motion/restoring/nearest_point.py": [
        (
            "            «self._descend(start, here)→pass»\n",
            "test_nearest_point.py::test_the_nearest_point_is_found_where_the_surface_is_much_bent",
        ),
    ],
    "motion/restoring/moved_groups.py": [
        (
            "«self._follow_fixed(y)→pass»",
            "test_moved_groups.py::test_fixed_atoms_that_go_elsewhere_take_their_molecule_along",
        ),
    ],
    "motion/restoring/kept_geometry.py": [
        (
            "if not «self._follows(x, entry[1])→False»]",
            "test_moved_groups.py::test_bonds_and_angles_that_rows_hold_may_change_as_the_rows_ask",
        ),
    ],
    "constraints/internal.py": [
        (
            "hb = «→-»(hx * gx + hy * gy + hz * gz) / (b2 * size)",
            "test_constraint.py::test_gradient_and_curvature_by_taylor_remainder[Dihedral-0]",
        ),
    ],
    "solvers/addressable_solvers.py": [
        (
            "_call_apply(words[k + 2], (v, «inv_dt→1.0», mine))",
            "test_addressable_solvers.py::test_the_same_as_from_python",
        ),
    ],
    "constraints/surface.py": [
        (
            "f, g = h / «(rho * q)→rho», up / q",
            "test_constraint.py::test_gradient_and_curvature_by_taylor_remainder[Torus-0]",
        ),
    ],
    "solvers/sparse/row_functions.py": [
        (
            "if np.a«ll→ny»(table == table[0]):",
            "test_single_rows.py::test_rows_agree_with_the_dense_solver[Sphere-open]",
        ),
    ],
    "solvers/single_rows.py": [
        (
            "store_double(solution, k, la«st + 0.5 * (lam - last)→m»)",
            "test_single_rows.py::test_steps_that_overshoot_are_halved",
        ),
        ("slope < «FLAT→0.0» * size", "test_single_rows.py::test_a_dihedral_that_turns_over_has_no_solution_far_away"),
    ],
    "solvers/kernels/eight_wide.py": [
        (
            '_EIGHT.all_true(builder, builder.fcmp_«→un»ordered("<=", value, limit))',
            "test_distance_solvers.py::test_failure_changes_nothing_and_names_the_cluster[nan-small-bond]",
        ),
    ],
    "solvers/kernels/two_and_four_wide.py": [
        (
            "total = builder.fadd(builder.load(front, align=8), shuffle(builder, value, value, [0, «1→0»]), f"
            "lags=FLAGS)",
            "test_distance_solvers.py::test_matches_dense_newton[sparse-comb]",
        ),
    ],
}
