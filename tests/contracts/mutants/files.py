"""Mutants of topologies and the check of trajectories."""

MUTANTS = [
    # -- checks of trajectories --
    (
        "mdanalysis/check/bound_rows.py",
        "self.table.allow(of_targets + self.tolerance * self.table.sizes)",
        "self.table.allow(self.tolerance * self.table.sizes)",
        "tests/mdanalysis/check/files/test_file_precision.py::test_two_roundings_make_more_than_one",
    ),
    (
        "mdanalysis/check/bound_rows.py",
        "self.table.allow(of_targets + self.tolerance * self.table.sizes)",
        "self.table.allow(of_targets + self.tolerance)",
        "tests/mdanalysis/check/files/test_file_precision.py::test_the_tolerance_is_a_part_of_the_length",
    ),
    (
        "mdanalysis/check/conclusions.py",
        "found.margins + rows.tolerance * table.sizes > 0",
        "found.margins + rows.tolerance > 0",
        "tests/mdanalysis/check/files/test_file_precision.py::test_the_tolerance_is_a_part_of_the_length",
    ),
    (
        "mdanalysis/check/bound_rows.py",
        "np.where(seen, found.mean(found.rounded), self.of_targets)",
        "self.of_targets",
        "tests/mdanalysis/check/files/test_file_precision.py::test_targets_that_are_means_have_the_mean_rounding_of_their_frames",
    ),
    (
        "mdanalysis/check/check_files.py",
        "precision.half_step(universe.atoms.positions)",
        "precision.half_step(universe.atoms.positions).max()",
        "tests/mdanalysis/check/files/test_file_precision.py::test_a_wild_molecule_of_the_topology_excuses_no_other",
    ),
    (
        "mdanalysis/check/frames/row_table.py",
        "np.where(periodic, 1.0, constraint_set.scale)",
        "np.where(periodic, 1.0, 1.0)",
        "tests/mdanalysis/check/files/test_file_precision.py::test_the_tolerance_is_a_part_of_the_length",
    ),
    (
        "constraints/periodic/in_cell.py",
        "change = change[self.lattice[1].any(axis=0)]",
        "change = change[:]",
        "tests/constraints/periodic/test_in_cell.py::test_directions_without_periodicity_do_not_count_as_a_change_of_the_cell",
    ),
    (
        "constraints/periodic/in_cell.py",
        "return np.where(same[:, None, None], near, r)",
        "return r",
        "tests/constraints/periodic/test_images.py::test_lengths_found_far_away_can_be_held_near_the_origin",
    ),
    (
        "constraints/contradictions.py",
        "same = open_ & (given[place] == key)",
        "same = open_ & (given[place] != given[place])",
        "tests/constraints/periodic/test_images.py::test_a_length_found_and_the_same_one_given",
    ),
    # -- topology: all angles --
    (
        "topology/rows_by_name.py",
        "_refuse_torn(snapshot, waters.triples[:, [[0, 1], [0, 2]]].reshape(-1, 2))",
        "pass",
        "tests/topology/test_rows_by_name.py::test_bodies_that_a_missing_cell_tears_are_refused",
    ),
    (
        "topology/angle_rows.py",
        "flat = volume < np.sin(np.radians(FLAT_CENTRE))",
        "flat = volume < -np.sin(np.radians(FLAT_CENTRE))",
        "tests/topology/test_angle_rows.py::test_a_flat_centre_has_an_improper_dihedral",
    ),
    (
        "topology/angle_rows.py",
        "-snapshot.topology.masses[others], rank",
        "+snapshot.topology.masses[others], rank",
        "tests/topology/test_angle_rows.py::test_of_six_angles_the_one_between_the_lightest_is_none_of_the_rows",
    ),
    (
        "topology/angle_rows.py",
        "turning = (earlier.sum(axis=1) == 1) & ~earlier[:, 0]",
        "turning = earlier.sum(axis=1) > 9",
        "tests/topology/test_angle_rows.py::test_beside_a_rigid_body_only_what_it_leaves_is_held",
    ),
    (
        "topology/ring_systems.py",
        "FLAT_RING = 20.0",
        "FLAT_RING = 0.0",
        "tests/topology/test_ring_systems.py::test_a_ring_is_rigid_by_as_many_rows_as_it_needs",
    ),
    (
        "topology/ring_systems.py",
        "_independent(rows[held], rows[~held])",
        "_independent(rows[:0], rows[~held])",
        "tests/topology/test_ring_systems.py::test_a_ring_is_rigid_by_as_many_rows_as_it_needs",
    ),
    (
        "openmm/ensembles/nose_hoover_ensemble.py",
        'self._advance(program, "2")',
        'self._advance(program, "1")',
        "tests/openmm/ensembles/test_nose_hoover_ensemble.py::test_a_chain_in_the_middle_is_the_same_chain_in_small_steps",
    ),
    (
        "openmm/integrator/step_writer.py",
        "self._project if self.ensemble.measures else lambda: None",
        "lambda: None",
        "tests/openmm/ensembles/test_nose_hoover_ensemble.py::test_a_chain_in_the_middle_is_time_reversible",
    ),
    (
        "topology/guessed_bonds.py",
        "wrapped = y if lattice is None else wrapped_into(y, lattice)[1]",
        "wrapped = y",
        "tests/motion/restoring/test_kept_geometry.py::test_bonds_in_a_cell_do_not_hang_on_where_atoms_are_stored",
    ),
    (
        "motion/failures.py",
        "_beside(then[first], then[first + 1]) <= 0.0",
        "_beside(then[first], then[first + 1]) <= -1.0",
        "tests/motion/test_failures.py::test_a_run_that_ends_where_a_dihedral_is_straight_names_no_time_step",
    ),
    (
        "motion/failures.py",
        '        here, step = ahead, ahead - here\n    return ""',
        "    return _straightened(constraint_set, numbers, *request[1::-1], rows)",
        "tests/motion/test_failures.py::test_a_dihedral_that_is_passed_in_small_parts_is_not_named",
    ),
    (
        "constraints/periodic/images.py",
        "| (not self._in_line)",
        "",
        "tests/constraints/test_distance_difference.py::test_each_pair_takes_its_shortest_image",
    ),
    (
        "constraints/periodic/images.py",
        "if self.item.links is None and 2 < self.item.width",
        "if 2 < self.item.width",
        "tests/constraints/test_distance_difference.py::test_pairs_of_a_row_need_not_be_near_each_other",
    ),
    (
        "motion/restoring/kept_geometry.py",
        "for leg in ((i, k), (k, i))",
        "for leg in ()",
        "tests/constraints/test_distance_difference.py::test_a_proton_goes_over_within_a_molecule_that_stays_as_it_is",
    ),
    (
        "constraints/periodic/images.py",
        "np.where(distance, length, BOND_LIKE * length)",
        "length",
        "tests/constraints/periodic/test_images.py::test_a_chain_of_moving_bonds_may_open_beyond_half_the_cell",
    ),
    (
        "solvers/sparse/step_control.py",
        "FLAT = 0.01",
        "FLAT = 0.0",
        "tests/solvers/sparse/test_mixed_rows.py::test_a_dihedral_that_turns_over_has_no_solution_far_away",
    ),
    (
        "topology/topology.py",
        "if not isinstance(given, kind):",
        "if given is None:",
        "tests/openmm/test_topology.py::test_what_is_no_topology_is_refused",
    ),
    (
        "ase/topology.py",
        "where=(masses != 0.0) | (momenta != 0.0)",
        "where=masses != -1.0",
        "tests/ase/test_logger.py::test_a_fixed_atom_needs_no_mass",
    ),
    (
        "openmm/collective/context_rows.py",
        "self._clock == 0.0",
        "self._clock >= 0.0",
        "tests/openmm/collective/test_clock.py::test_a_state_of_another_program_has_no_time_of_targets",
    ),
]
