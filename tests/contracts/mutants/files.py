"""Mutants of topologies and the check of trajectories."""

MUTANTS = {
    "mdanalysis/writing.py": [
        (
            "«other._writer is not None→False» and other.path.resolve()",
            "mdanalysis/test_writing.py::test_a_file_has_one_writer",
        ),
    ],
    "mdanalysis/check/deviations.py": [
        (
            'self._table["slack"] = «of_targets + →»self.tolerance * self.sizes',
            "mdanalysis/check/test_precision.py::test_two_roundings_make_more_than_one",
        ),
        (
            'self._table["slack"] = of_targets + self.tolerance« * self.sizes→»',
            "mdanalysis/check/test_precision.py::test_the_tolerance_is_a_part_of_the_length",
        ),
        (
            '«np.where(seen, found.mean("rounded"), self.of_targets)→self.of_targets»',
            "mdanalysis/check/test_precision.py::test_targets_that_are_means_have_the_mean_rounding_of_their_frames",
        ),
        (
            "np.where(angular, 1.0, «held.scale→1.0»)",
            "mdanalysis/check/test_precision.py::test_the_tolerance_is_a_part_of_the_length",
        ),
        (
            "factor * (powers[i] + powers[«j→i»])",
            "mdanalysis/check/test_precision.py::test_what_is_allowed_is_the_rounding_of_both_atoms_and_the_tolerance",
        ),
        (
            "«exponent if exponent >= least else →»0",
            "mdanalysis/check/test_precision.py::test_xtc_beyond_the_reach_of_its_grid",
        ),
    ],
    "mdanalysis/check/result.py": [
        (
            "margins + table.tolerance «* table.sizes →»> 0",
            "mdanalysis/check/test_precision.py::test_the_tolerance_is_a_part_of_the_length",
        ),
        (
            'if rms > «found.units["rounding"][:, unit].max() + table.tolerance * table.sizes[mine].min()→np.inf»:',
            "test_deviations.py::test_other_frames_that_are_off_are_not_the_first_alone",
        ),
    ],
    "mdanalysis/check/constraint_check.py": [
        (
            "precision.half_step(universe.atoms.positions)«→.max()»",
            "mdanalysis/check/test_precision.py::test_a_wild_molecule_of_the_topology_excuses_no_other",
        ),
    ],
    "mdanalysis/check/endings.py": [
        ('"GRO": «n_atoms + 3→2 * n_atoms + 6»,', "test_endings.py::test_what_lies_behind_the_only_frame_that_is_read"),
        ("word.isdigit()« and int(word) == n_atoms→»", "test_endings.py::test_a_frame_with_another_number_of_atoms"),
    ],
    "mdanalysis/check/precision.py": [
        ("_off_grid(x, «10 * step) >→step) <=» error", "mdanalysis/check/test_precision.py::test_what_is_no_grid"),
    ],
    "constraints/constraint_set.py": [
        (
            "change = change[«self.lattice[1].any(axis=0)→:»]",
            "test_images.py::test_directions_without_periodicity_do_not_count_as_a_change_of_the_cell",
        ),
        (
            "return «np.where(same[:, None, None], near, r)→r»",
            "test_images.py::test_lengths_found_far_away_can_be_held_near_the_origin",
        ),
        (
            "return «x→whole»[item.atoms] if self.moved is None",
            "test_places.py::test_a_molecule_is_the_same_in_the_cell_as_in_open_space",
        ),
    ],
    "constraints/contradictions.py": [
        (
            "same = open_ & (given[place] «== key→!= given[place]»)",
            "test_images.py::test_a_length_found_and_the_same_one_given",
        ),
    ],
    "constraints/constraint.py": [
        ('powers.get("length", «0→1»)', "test_constraint.py::test_the_same_points_fulfil_it"),
        ('not powers.keys() <= {«→"unknown", »', "test_constraint.py::test_what_has_no_known_units_is_refused"),
    ],
    "topology/rows_by_name.py": [
        (
            "«_refuse_torn(snapshot, waters.triples[:, [[0, 1], [0, 2]]].reshape(-1, 2))→pass»",
            "test_rows_by_name.py::test_bodies_that_a_missing_cell_tears_are_refused",
        ),
    ],
    "topology/angle_rows.py": [
        (
            "flat = volume < «→-»np.sin(np.radians(FLAT_CENTER))",
            "test_angle_rows.py::test_a_flat_center_has_an_improper_dihedral",
        ),
        (
            "«-→+»snapshot.topology.masses[others], rank",
            "test_angle_rows.py::test_of_six_angles_the_one_between_the_lightest_is_none_of_the_rows",
        ),
        (
            "turning = «(earlier.sum(axis=1) == 1) & ~earlier[:, 0]→earlier.sum(axis=1) > 9»",
            "test_angle_rows.py::test_beside_a_rigid_body_only_what_it_leaves_is_held",
        ),
        ("FLAT_RING = «2→»0.0", "test_ring_systems.py::test_a_ring_is_rigid_by_as_many_rows_as_it_needs"),
        (
            "_independent(rows[«held→:0»], rows[~held])",
            "test_ring_systems.py::test_a_ring_is_rigid_by_as_many_rows_as_it_needs",
        ),
    ],
    "openmm/ensembles/nose_hoover_ensemble.py": [
        (
            'self._advance(step.program, "«2→1»")',
            "test_nose_hoover_ensemble.py::test_a_chain_in_the_middle_is_the_same_chain_in_small_steps",
        ),
        ("«        step.project()\n→»", "test_nose_hoover_ensemble.py::test_a_chain_in_the_middle_is_time_reversible"),
    ],
    "topology/guessed_bonds.py": [
        (
            "wrapped = y« if lattice is None else wrapped_into(y, lattice)[1]→»",
            "test_moved_groups.py::test_bonds_in_a_cell_do_not_hang_on_where_atoms_are_stored",
        ),
    ],
    "motion/failures.py": [
        (
            "_beside(then[first], then[first + 1]) <= «0→-1».0",
            "test_failures.py::test_a_dihedral_that_becomes_straight_is_named",
        ),
    ],
    "plan/clusters.py": [
        (
            "single &= «~anchored→anchored >= 0»",
            "test_places.py::test_a_molecule_is_the_same_in_the_cell_as_in_open_space",
        ),
    ],
    "motion/solver_sequence.py": [
        (
            "                moved = None« if places is None else rows.moved_places(places, x)→»",
            "test_places.py::test_a_molecule_is_the_same_in_the_cell_as_in_open_space",
        ),
    ],
    "constraints/arguments.py": [
        (
            "good = np.«abs(values) <= LARGEST→isfinite(values)»",
            "test_target.py::test_numbers_whose_squares_overflow_are_refused",
        ),
    ],
    "constraints/periodic/images.py": [
        ("«| (not self._in_line)→»", "test_distance_difference.py::test_each_pair_takes_its_shortest_image"),
        (
            "if «self.item.links is None and →»2 < self.item.width",
            "test_distance_difference.py::test_pairs_of_a_row_need_not_be_near_each_other",
        ),
        (
            "«np.where(distance, length, BOND_LIKE * length)→length»",
            "test_images.py::test_a_chain_of_moving_bonds_may_open_beyond_half_the_cell",
        ),
    ],
    "motion/restoring/kept_geometry.py": [
        (
            "for leg in («(i, k), (k, i)→»)",
            "test_distance_difference.py::test_a_proton_goes_over_within_a_molecule_that_stays_as_it_is",
        ),
    ],
    "solvers/tolerances.py": [
        ("FLAT = 0.0«1→»", "test_mixed_rows.py::test_a_dihedral_that_turns_over_has_no_solution_far_away"),
    ],
    "topology/topology.py": [
        (
            "if «not isinstance(given, kind)→given is None»:",
            "openmm/test_topology.py::test_what_is_no_topology_is_refused",
        ),
    ],
    "ase/topology.py": [
        (
            "where=«(masses != 0.0) | (momenta != 0.0)→masses != -1.0»",
            "test_logger.py::test_a_fixed_atom_needs_no_mass",
        ),
    ],
    "openmm/collective/collective_rows.py": [
        (
            "self._clock(holder) «=→>»= 0.0",
            "test_row_program.py::test_a_state_of_another_program_has_no_time_of_targets",
        ),
    ],
}
