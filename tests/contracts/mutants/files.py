"""Mutants of topologies and the check of trajectories."""

MUTANTS = {
    "mdanalysis/conversions.py": {
        "] if «len(still)→False» else []": "mdanalysis/conversions::converted_atoms_carry_constraints",
    },
    "cli/compare.py": {
        'sha256(«path.read_bytes()→b""»)': "cli/compare",
    },
    "mdanalysis/writing.py": {
        "«other._writer is not None→False» and other.path.resolve()": "mdanalysis/writing::a_file_has_one_writer",
        '«velocities is None→False» and "velocities" in self._kept': "mdanalysis/writing::a_file_has_one_writer",
        'arrays["positions"], «np.nan→0.0»)': "mdanalysis/writing::forces_that_a_state_does_not_know_are_not_zero",
    },
    "mdanalysis/check/deviations.py": {
        "«of_targets + →»self.tolerance * self.sizes": "mdanalysis/check/precision::two_roundings_make_more_than_one",
        "+ self.tolerance« * self.sizes→»": "mdanalysis/check/precision::the_tolerance_is_a_part_of_the_length",
        '«np.where(seen, found.mean("rounded"), self.of_targets)→self.of_targets»': (
            "mdanalysis/check/precision::targets_that_are_means_have_the_mean_rounding_of_their_frames"
        ),
        "angular), 1.0, «held.scale→1.0»)": "mdanalysis/check/precision::the_tolerance_is_a_part_of_the_length",
        "n_rows + r) + one« - told→»)": "deviations::targets_of_the_first_frame_and_of_the_mean",
        "rate = «where_greater(rounding, bound, zero, rate)→told * rate»": (
            "deviations::where_atoms_coincide_nothing_is_told_of_their_angle"
        ),
        "off, size = «where_greater(rounding, bound, zero, off)→off»,": (
            "mdanalysis/check/precision::rows_of_which_nothing_can_be_told_leave_a_check_incomplete"
        ),
        "«exponent if exponent >= least else →»0": "mdanalysis/check/precision::xtc_beyond_the_reach_of_its_grid",
    },
    "mdanalysis/check/result.py": {
        '["turning"][has].mean() «<→>» least': (
            "mdanalysis/check/results::temperature_counts_the_right_degrees_of_freedom"
        ),
        "+ table.tolerance «* table.sizes →»> 0": "mdanalysis/check/precision::the_tolerance_is_a_part_of_the_length",
        'if rms > «found.units["rounding"][:, unit].max() + table.tolerance * table.sizes[mine].min()→np.inf»:': (
            "deviations::other_frames_that_are_off_are_not_the_first_alone"
        ),
    },
    "mdanalysis/check/constraint_check.py": {
        "«reader.skip_timestep == 1→True» and": "mdanalysis/check/targets::times_that_files_do_not_have_are_said",
        "    «_ = reader[numbers[-1]]→pass»": "deviations::rows_that_were_made_for_a_part_are_refused",
        "« & (cells[:, ::13] == 48).all(axis=1)→»": "endings::records_of_all_kinds_of_dcd",
        '«str(given.get("select", "all")) != "all"→False»': (
            "mdanalysis/check/results::of_a_selection_there_is_no_temperature"
        ),
        ".half_step(universe.atoms.positions)«→.max()»": (
            "mdanalysis/check/precision::a_wild_molecule_of_the_topology_excuses_no_other"
        ),
    },
    "comparison/trajectory_temperatures.py": {
        '"frame": «frames[0]→0»}': (
            "trajectory_temperatures::lengths_and_box_are_those_of_the_first_frame_that_is_looked_at"
        ),
    },
    "mdanalysis/check/endings.py": {
        "if «cell[:4] != cell[52:] or→»": "endings::records_of_all_kinds_of_dcd",
        'cell[52:]« or cell[:4] not in (b"0\\0\\0\\0", b"\\0\\0\\x000")→»:': "endings::records_of_all_kinds_of_dcd",
        '"GRO": «n_atoms + 3→2 * n_atoms + 6»,': "endings::what_lies_behind_the_only_frame_that_is_read",
        "word.isdigit()« and int(word) == n_atoms→»": "endings::a_frame_with_another_number_of_atoms",
    },
    "mdanalysis/check/precision.py": {
        "_off_grid(x, «10 * step) >→step) <=» error": "mdanalysis/check/precision::what_is_no_grid",
    },
    "constraints/constraint_set.py": {
        "agreed = np.where(«open_→False», np.repeat": "images::lengths_found_far_away_can_be_held_near_the_origin",
        "change = change[«periodic→:»]": "images::directions_without_periodicity_do_not_count_as_a_change_of_the_cell",
        "«self._refuse_cut(item, r, time, int(start))→pass»": (
            "formula::atoms_cut_by_a_face_of_the_cell_are_refused_unless_it_is_said_what_is_meant"
        ),
        "r if together is y else self.gather(item, x, «together→y»)": (
            "images::lengths_found_far_away_can_be_held_near_the_origin"
        ),
        "«x→whole»[item.atoms] if self.moved is None": "images::a_molecule_is_the_same_in_the_cell_as_in_open_space",
    },
    "constraints/constraint.py": {
        "self.target is not None and «self.held is LENGTH→True»:": "constraint::the_same_points_fulfil_it",
        "if self.moving or «not self.held→False»:": "constraint::what_has_no_known_units_is_refused",
    },
    "topology/rows_by_name.py": {
        "Distance(held[«~np.isin(held @ code, np.delete(arms, one))→:»])": (
            "angle_rows::rows_of_straight_molecules_are_independent_wherever_they_point"
        ),
        "«_refuse_torn(snapshot, waters.triples[:, [[0, 1], [0, 2]]].reshape(-1, 2))→pass»": (
            "rows_by_name::bodies_that_a_missing_cell_tears_are_refused"
        ),
    },
    "topology/angle_rows.py": {
        "flat = volume < «→-»np.sin(np.radians(FLAT_CENTER))": "angle_rows::a_flat_center_has_an_improper_dihedral",
        "«-→+»snapshot.topology.masses": "angle_rows::of_six_angles_the_one_between_the_lightest_is_none_of_the_rows",
        "turning = «(earlier.sum(axis=1) == 1) & ~earlier[:, 0]→earlier.sum(axis=1) > 9»": (
            "angle_rows::beside_a_rigid_body_only_what_it_leaves_is_held"
        ),
        "FLAT_RING = «2→»0.0": "angle_rows::a_ring_is_rigid_by_as_many_rows_as_it_needs",
        "_independent(rows[«held→:0»], rows[~held])": "angle_rows::a_ring_is_rigid_by_as_many_rows_as_it_needs",
    },
    "openmm/ensembles/nose_hoover_ensemble.py": {
        '(p, "«2→1»")': "nose_hoover_ensemble::a_chain_in_the_middle_is_the_same_chain_in_small_steps",
        "«        p.project()\n→»": "nose_hoover_ensemble::a_chain_in_the_middle_is_time_reversible",
    },
    "topology/topology.py": {
        "wrapped = y« if lattice is None else wrapped_into(y, lattice)[1]→»": (
            "restoring::bonds_in_a_cell_do_not_hang_on_where_atoms_are_stored"
        ),
        "if «not isinstance(given, kind)→given is None»:": (
            "openmm/topology::what_does_not_fit_or_is_no_topology_is_refused"
        ),
    },
    "plan/clusters.py": {
        "single &= «~anchored→anchored >= 0»": "images::a_molecule_is_the_same_in_the_cell_as_in_open_space",
    },
    "motion/solver_sequence.py": {
        "_beside(then[first], then[first + 1]) <= «0→-1».0": "motion::a_dihedral_that_becomes_straight_is_named",
        "                moved = None« if places is None else rows.moved_places(places, x)→»": (
            "images::a_molecule_is_the_same_in_the_cell_as_in_open_space"
        ),
    },
    "constraints/arguments.py": {
        "good = np.«abs(values) <= LARGEST→isfinite(values)»": "target::numbers_whose_squares_overflow_are_refused",
    },
    "constraints/periodic/images.py": {
        "«| (not self._in_line)→»": "families::each_pair_takes_its_shortest_image",
        "«self.item.links is None and →»2 < self.": "families::pairs_of_a_row_need_not_be_near_each_other",
        "«np.where(distance, length, BOND_LIKE * length)→length»": (
            "images::a_chain_of_moving_bonds_may_open_beyond_half_the_cell"
        ),
    },
    "motion/restoring/kept_geometry.py": {
        "leg in («(i, k), (k, i)→»)": "families::a_proton_goes_over_within_a_molecule_that_stays_as_it_is",
    },
    "solvers/tolerances.py": {
        "FLAT = 0.0«1→»": "row_functions::a_dihedral_that_turns_over_has_no_solution_far_away",
    },
    "ase/topology.py": {
        "found[«~np.isin(molecule[found[:, 0]], molecule[given])→:0»]": (
            "ase/topology::bonds_are_guessed_where_none_are_given"
        ),
        "    if «len(loose)→False»:": "ase/topology::rigid_water_tells_of_stretched_water",
        "where=«(masses != 0.0) | (momenta != 0.0)→masses != -1.0»": "ase/topology::velocities_of_atoms_without_mass",
    },
    "openmm/collective/collective_rows.py": {
        "self._clock(holder) «=→>»= 0.0": "row_program::a_state_of_another_program_has_no_time_of_targets",
    },
}
