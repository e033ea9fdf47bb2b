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
]
