"""Mutants of the solvers."""

MUTANTS = {
    "constraints/compilation.py": {
        ".linkage = llvm.Linkage.«internal→linkonce_odr»": "compilation::a_kernel_calls_its_own_copies_of_others",
        "«except Exception:  # pickle→except ZeroDivisionError:  # pickle»": "compilation::damaged_files_are_made_anew",
    },
    "constraints/functions/formula.py": {
        "np.isfinite([«value→slopes[0]», *slopes]).all(": "formula::formulas_without_bound_are_refused_at_once",
        "lambda _, x: «next(some)→-np.ones(40)»": "formula::shifts_are_found_out",
    },
    "constraints/constraint.py": {
        "if found is not None«→ and False»": (
            "constraints/constraint::wrong_derivatives_of_a_family_of_ones_own_are_refused"
        ),
        ", v, time + step) «+→- 0 *»": "constraint_set::acceleration_target_is_the_second_derivative_along_any_curve",
    },
    "solvers/tolerances.py": {
        "DENSE_SPEED_TOLERANCE = 1e-«11→7»": "general_clusters::velocities_that_cannot_be_tangent_are_refused",
        "NEWTON_TOLERANCE = «0.4→4e3» * ROUNDING": "distance_solvers::matches_dense_newton[sparse-comb]",
    },
    "solvers/general_clusters.py": {
        "np.maximum(«ROUNDING→1e-10», 2 * EPS": "general_clusters::no_more_is_left_than_rounding",
        "2«→e4» * EPS * reach / self._scale": "general_clusters::no_more_is_left_than_rounding",
        '(np.einsum("nkc,nkc->nk", b, b0) > «least→-np.inf»)': "general_clusters::the_other_side_is_no_solution",
        "+= «~done→1»": "general_clusters::what_many_iterations_ask_for_is_asked_of_the_clusters_that_took_them",
        'wanted = wanted «-→+» np.einsum("nkc,nc->nk"': "general_clusters::atoms_of_infinite_mass_move_as_prescribed",
    },
    "solvers/sparse/distances.py": {
        "total «-→+»= w[i]": "distance_solvers::matches_dense_newton[sparse-comb]",
        ") > «0.→-1e30»0):": "distance_solvers::failure_changes_nothing_and_names_the_cluster[turned-sparse-methane]",
        "load_double(p.wanted, k) * «np.sqrt(s2)→s2»": "distance_solvers::tangents_match_dense_solve[True-sparse-comb]",
    },
    "solvers/small_clusters.py": {
        "«TINY→-1e300», inner)": "distance_solvers::failure_changes_nothing_and_names_the_cluster[turned-small-bond]",
        "kept_points, «n_local→0»": "distance_solvers::failure_changes_nothing_and_names_the_cluster[far-small-bond]",
        "rate = rate * square«_root(square)→»": "distance_solvers::tangents_match_dense_solve[True-small-bond]",
    },
    "solvers/rigid_triangles.py": {
        "(TINY, inner[1])« and all_within(TINY, inner[2])→»": (
            "distance_solvers::a_third_side_that_turned_round_is_no_solution"
        ),
        "c10, c11, c12 = -(a12 * a20 «+→-» a10 * a22)": "distance_solvers::newton_and_a_chord_step_gain_together",
        "(w2 * m2, «-→»w2 * (m1 + m2))": "distance_solvers::matches_dense_newton[triangles-8]",
        "_CORNERS, kept_points, «_CORNERS→_NONE»)": (
            "distance_solvers::failure_changes_nothing_and_names_the_cluster[far-triangles-29]"
        ),
    },
    "solvers/chains.py": {
        "minus(v, «times(d, inverse_dt)→d»)": "distance_solvers::matches_dense_newton[chains-short-free]",
        "times(«minus(times(s, later), times(p, later_before))→times(s, later)», w)": (
            "distance_solvers::ten_thousand_bonds[straight]"
        ),
        "minus(«g, f→f, g»), load(present, end)": "distance_solvers::ten_thousand_bonds[free]",
    },
    "solvers/sparse/mixed_rows.py": {
        "if abs(d) > «PIVOT_TOLERANCE * abs(whole)→0.0» else 0.0": "row_functions::dependent_rows_are_dropped",
        "(along > «0.→-1e30»0)": "row_functions::a_molecule_turned_through_a_point_is_no_solution_though_its_rows_hold",
        "= «(here - load_quad(moved, 4 * p))→here» +": "images::a_molecule_is_the_same_in_the_cell_as_in_open_space",
        "= «period * np.rint(→0.5 * period * np.rint(2 * »": (
            "row_functions::rows_with_a_period_miss_by_the_shorter_way"
        ),
    },
    "solvers/kernels/any_width.py": {
        "(pair«[::-1]→» if swap": "distance_solvers::matches_dense_newton[triangles-8]",
    },
    "solvers/kernels/lattices.py": {
        "(i * a[n] + j * b[n]« + k * c[n]→»)": "distance_solvers::periodic_equals_unwrapped",
    },
    "motion/restoring/nearest_point.py": {
        "        «self._descend(start, here)→pass»\n": (
            "restoring::the_nearest_point_is_found_where_the_surface_is_much_bent"
        ),
    },
    "motion/restoring/moved_groups.py": {
        "«self._follow_fixed(y)→pass»": "restoring::fixed_atoms_that_go_elsewhere_take_their_molecule_along",
    },
    "motion/restoring/kept_geometry.py": {
        "if not «self._follows(x, entry[1])→False»]": (
            "restoring::bonds_and_angles_that_rows_hold_may_change_as_the_rows_ask"
        ),
    },
    "constraints/internal.py": {
        "«→-»(hx * gx + hy * gy + hz * gz) / (": "constraint::gradient_and_curvature_by_taylor_remainder[Dihedral-0]",
    },
    "solvers/addressable_solvers.py": {
        "_call_apply(words[k + 2], (v, «inv_dt→1.0», mine))": "single_rows::the_same_as_from_python",
    },
    "constraints/surface.py": {
        "f, g = h / «(rho * q)→rho», up / q": "constraint::gradient_and_curvature_by_taylor_remainder[Torus-0]",
    },
    "solvers/sparse/row_functions.py": {
        "if np.a«ll→ny»(table == table[0]):": (
            "row_functions::kernels_agree_with_the_dense_solver[SingleRows-Sphere-near]"
        ),
    },
    "solvers/single_rows.py": {
        "store_double(solution, k, la«st + 0.5 * (lam - last)→m»)": "single_rows::steps_that_overshoot_are_halved",
        "slope < «FLAT→0.0» * size": "single_rows::a_dihedral_that_turns_over_has_no_solution_far_away",
    },
    "solvers/kernels/eight_wide.py": {
        "1.0, 1.0, «-1.0→1.0»]": (
            "mdanalysis/check/precision::what_is_allowed_is_the_rounding_of_both_atoms_and_the_tolerance"
        ),
        '«→un»ordered("<=", value': "distance_solvers::failure_changes_nothing_and_names_the_cluster[nan-small-bond]",
    },
    "solvers/kernels/two_and_four_wide.py": {
        ", shuffle(builder, value, value, [0, «1→0»]), flags=": "distance_solvers::matches_dense_newton[sparse-comb]",
    },
}
