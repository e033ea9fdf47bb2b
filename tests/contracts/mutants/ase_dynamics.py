"""Mutants of dynamics in ASE."""

MUTANTS = {
    "ase/dynamics.py": {
        "«require_on_surface(system.motion.constraint_set, x, self.time)→pass»\n                last = replace": (
            "binding::time_that_is_set_is_no_way_of_moving_targets"
        ),
        'step == self.nsteps« and np.array_equal(self.atoms.arrays["momenta"], self._momenta)→»': (
            "dynamics::with_noise_the_log_is_of_the_middle_of_the_step"
        ),
        "replace(state.copied(), **known«, forces=None, origin=None→»)": (
            "thermostat_dynamics::a_restart_asks_the_calculator_for_forces"
        ),
        "if last is not None and «not all(map(is_, asked, self._asked))→asked[0] is not self._asked[0]»:": (
            "binding::forces_of_the_same_calculator_that_changed"
        ),
        '("numbers",« "initial_charges", "initial_magmoms"→»)': "binding::forces_of_the_same_calculator_that_changed",
        "if «gone > 0→False» and self._more": "binding::what_was_given_by_numbers_of_atoms_is_no_longer_of_these",
        "positions, v, «applied_forces(atoms)→0 * atoms.positions», time)": "dynamics::multipliers_by_name",
    },
    "ase/thermostat_dynamics.py": {
        'options["rng"] = self.seed = seed_from(«options.get("rng")→None»)': (
            "thermostat_dynamics::several_time_steps_are_those_of_the_core"
        ),
    },
    "thermostats/langevin.py": {
        "if self.thermostat.friction >«→=» 0:": "dynamics::without_noise_the_log_is_of_the_end[0.0]",
    },
    "ase/constraints_object.py": {
        "«self._binding = None→»  # which rows": "constraints_object::momenta_go_along_and_the_rank_is_that_of_the_end",
        "for item in self.constraints« if item.n_rows→»]": "translation::objects_without_rows_are_left_out_of_files",
        "if isinstance(item, «FORCES_ONLY→()») and type(item).adjust": "binding::momenta_without_the_force_of_company",
        "> «START_TOLERANCE→np.inf»:": "ase/pressure::what_scales_atoms_past_their_constraints_is_refused",
        "if «not self._own→False» and cell.tobytes() != bound.cell": "binding::copies_in_cells_of_their_own",
        "«WithFixedAtoms if fixed else Constraints→»  #": "translation::files_of_other_programs_have_the_fixed_atoms",
        "«            self._accepted.between_steps = True\n→»": "binding::an_edit_between_runs_is_refused",
        "«with→if» IN_TURN:\n            bound = self._bound(atoms)\n            f,": (
            "binding::copies_are_asked_in_turn"
        ),
        "f if added is None else f + «added→0»": (
            "translation::attach_keeps_objects_that_add_forces_and_refuses_unknown_ones"
        ),
        "if «found & FAR and np.isfinite(x).all() and fulfilled(motion.constraint_set, x)→False»:": (
            "binding::frames_on_the_constraints_are_taken"
        ),
    },
    "ase/binding.py": {
        "(item, «holding(item)→None») for": "dynamics::what_constraints_hold_changed_between_steps_is_taken",
        "name«, arrays[name].tobytes()→»": "dynamics::masses_of_free_atoms_changed_between_steps_are_taken",
        "scaled = «changed and self._scaled(motion, x, cell)→True»": "binding::an_edit_between_runs_is_refused",
        "«not (changed or elsewhere or differ(self._positions, x))→self._cell is not None»": (
            "binding::an_edit_between_runs_is_refused"
        ),
        "        if «along < stayed→False»:": "ase/pressure::filters_beside_atoms_that_stay_are_refused",
        "if «self._again and self._repeats→False»:": "binding::classes_that_move_atoms_past_constraints_are_found",
    },
    "ase/topology.py": {
        'hasattr(dynamics, "«motion→»")': "dynamics::fixed_atoms_that_move_have_velocities",
    },
    "constraints/arguments.py": {
        "«array.setflags(write=False)→pass»": "constraint::arrays_cannot_be_changed",
    },
    "thermostats/cells.py": {
        "motion.multipliers(x, v, f«, time→»)": "measured::a_rod_that_is_made_longer",
    },
    "thermostats/freedom.py": {
        "if «not attempt and→False and» len(directions):": "freedom::the_thermostats_hold_what_is_counted_by_hand",
        "«turns.see(*next(places))→break»": "freedom::angular_momentum_about_the_axes_of_what_is_held_is_said",
        "share = BALANCED« if len(self._motions) == 6 else EXACT→»": (
            "freedom::the_thermostats_hold_what_is_counted_by_hand"
        ),
        "«SHAKE→1e-9» * known": "freedom::a_lattice_that_exerts_no_torque_by_symmetry_is_no_cluster",
    },
    "steppers/state.py": {
        "if state.remainder is None« or self._free_of_origin is None→»:": (
            "state::what_is_kept_of_places_far_away_is_nothing_to_rows_with_a_place"
        ),
    },
    "steppers/stepper.py": {
        "if not residual <«= self.tolerance→ 1e300»:": "state::check_finds_a_stepper_that_is_not_reversible",
        ': «None if name in ("_known", "_left") else →»': "state::copies_leave_behind_what_was_found_for_a_system",
    },
}
