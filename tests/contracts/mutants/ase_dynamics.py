"""Mutants of dynamics in ASE."""

MUTANTS = [
    (
        "ase/dynamics.py",
        'step == self.nsteps and np.array_equal(self.atoms.arrays["momenta"], self._momenta)',
        "step == self.nsteps",
        "tests/ase/test_logger.py::test_a_thermostat_that_leaves_total_momentum_alone",
    ),
    (
        "thermostats/langevin.py",
        "if self.thermostat.friction > 0:",
        "if self.thermostat.friction >= 0:",
        "tests/ase/test_logger.py::test_without_noise_the_log_is_of_the_end[0.0]",
    ),
    (
        "ase/constraints_object.py",
        "ConstraintsWithFixedAtoms if fixed else Constraints  #",
        "Constraints  #",
        "tests/ase/test_ase_objects.py::test_files_of_other_programs_have_the_fixed_atoms",
    ),
    # -- ASE: what changes between steps --
    (
        "ase/binding.py",
        "((now := holding(item)) is not held and now != held)",
        "False",
        "tests/ase/test_dynamics.py::test_what_constraints_hold_changed_between_steps_is_taken",
    ),
    (
        "ase/binding.py",
        "if content == known and same_cell and bound.fits(atoms):",
        "if content == known and bound.fits(atoms):",
        "tests/ase/test_binding.py::test_frames_that_differ_have_engines_of_their_own",
    ),
    (
        "ase/dynamics.py",
        "replace(state.copied(), forces=None, origin=None)",
        "state.copied()",
        "tests/ase/test_thermostat_dynamics.py::test_a_restart_asks_the_calculator_for_forces",
    ),
    (
        "constraints/arguments.py",
        "array.setflags(write=False)",
        "pass",
        "tests/constraints/test_constraint.py::test_arrays_cannot_be_changed",
    ),
    (
        "ase/respect.py",
        "scaled = changed and self._scaled(motion, x, cell)",
        "scaled = True",
        "tests/ase/test_edits.py::test_an_edit_between_runs_is_refused",
    ),
    (
        "ase/respect.py",
        "good = not (changed or (differ(self._accepted, x) if elsewhere is None else elsewhere))",
        "good = self._cell is not None",
        "tests/ase/test_edits.py::test_an_edit_between_runs_is_refused",
    ),
    (
        "ase/constraints_object.py",
        "        watch.between_steps = True\n\n    def get_removed_dof",
        "\n    def get_removed_dof",
        "tests/ase/test_edits.py::test_an_edit_is_named_before_a_class",
    ),
    (
        "ase/constraints_object.py",
        "frame = found & FAR and np.isfinite(x).all() and fulfilled(motion.constraint_set, x, bound.touched)",
        "frame = False",
        "tests/ase/test_edits.py::test_frames_on_the_constraints_are_taken",
    ),
    (
        "ase/dynamics.py",
        "self.time, all_masses=True)",
        "self.time)",
        "tests/ase/test_dynamics.py::test_masses_of_free_atoms_changed_between_steps_are_taken",
    ),
    (
        "ase/dynamics.py",
        "if last is not None and not all(map(is_, asked, self._asked)):",
        "if last is not None and asked[0] is not self._asked[0]:",
        "tests/ase/test_binding.py::test_forces_of_the_same_calculator_that_changed",
    ),
    (
        "ase/dynamics.py",
        '("numbers", "initial_charges", "initial_magmoms")',
        '("numbers",)',
        "tests/ase/test_binding.py::test_forces_of_the_same_calculator_that_changed",
    ),
    (
        "ase/dynamics.py",
        "if now < before and (self._more",
        "if False and (self._more",
        "tests/ase/test_binding.py::test_what_was_given_by_numbers_of_atoms_is_no_longer_of_these",
    ),
    (
        "ase/respect.py",
        "        if along < stayed:",
        "        if False:",
        "tests/ase/pressure/test_virial.py::test_filters_beside_atoms_that_stay_are_refused",
    ),
    (
        "ase/respect.py",
        "if self._again and self._repeats:",
        "if False:",
        "tests/ase/test_respect.py::test_classes_that_move_atoms_past_constraints_are_found",
    ),
    (
        "ase/logger.py",
        'dyn.applied_forces() if hasattr(dyn, "motion") else applied_forces(atoms)',
        "applied_forces(atoms)",
        "tests/ase/test_logger.py::test_a_rod_against_friction",
    ),
    (
        "thermostats/pressure/measured.py",
        "motion.multipliers(x, v, f, time)",
        "motion.multipliers(x, v, f)",
        "tests/thermostats/pressure/test_measured.py::test_a_rod_that_is_made_longer",
    ),
    (
        "thermostats/freedom.py",
        "turns.see(*next(places))",
        "break",
        "tests/thermostats/test_freedom.py::test_angular_momentum_about_the_axes_of_what_is_held_is_said",
    ),
    (
        "thermostats/freedom.py",
        "share = BALANCED if len(self._motions) == 6 else EXACT",
        "share = BALANCED",
        "tests/thermostats/test_freedom.py::test_a_lattice_that_exerts_no_torque_by_symmetry_is_no_cluster",
    ),
    (
        "steppers/state.py",
        "if state.remainder is None or self._free_of_origin is None:",
        "if state.remainder is None:",
        "tests/steppers/test_state.py::test_what_is_kept_of_places_far_away_is_nothing_to_rows_with_a_place",
    ),
    (
        "steppers/stepper.py",
        "{name: None if name in found else value",
        "{name: value",
        "tests/steppers/test_stepper.py::test_copies_leave_behind_what_was_found_for_a_system",
    ),
]
