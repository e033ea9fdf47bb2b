"""Mutants of steppers, thermostats, images and certificates."""

MUTANTS = {
    "motion/solver_sequence.py": [
        (
            "«np.copyto(velocities, saved[1])→pass»\n            if isinstance(error",
            "test_motion.py::test_velocities_are_put_back_when_a_later_solver_fails",
        ),
        (
            "rows.target(«0.5 * (reference_time + time)→reference_time»)",
            "test_flights.py::test_driven_velocities_hold_at_the_middle_of_the_time",
        ),
        (
            "rows.target(«0.5 * (reference_time + time)→reference_time + 0.5 * flight»)",
            "test_friction.py::test_rows_of_velocities_keep_order_and_way_back",
        ),
    ],
    "steppers/interpreter.py": [
        (
            "reference_time=self.at(row.«begin→end»)",
            "test_flights.py::test_impulses_act_along_the_gradients_of_the_time_of_the_start",
        ),
        (
            "if «held.lattice is not cell or given.lattice is not cell→False»:",
            "test_interpreter.py::test_a_cell_that_the_force_function_changes",
        ),
        (
            "self.time + «(until * dt + self.left_over)→until * dt»",
            "test_interpreter.py::test_times_within_a_step_are_exact",
        ),
        ("self.made += 1«\n        self.number += 1→»", "test_interpreter.py::test_errors_name_the_step"),
        (
            "«and kept[2] == known→»",
            "test_interpreter.py::test_a_temperature_that_is_changed_between_steps_counts_at_once",
        ),
        (
            "«if self.low is not None:\n                    self.low.fill(0.0)\n                →»self._next_step()",
            "test_interpreter.py::test_steps_in_kernels_are_those_of_the_engine",
        ),
        (
            "self.time + «(end * self.dt + self.left_over)→end * self.dt»",
            "test_interpreter.py::test_times_within_a_step_are_exact",
        ),
        (
            "size = «max(start, float(np.abs(push).max(initial=0.0)), float(np.abs(v).max(initial=0.0)→float("
            "np.abs(v).max(initial=0.0»))",
            "test_coming_to_rest.py::test_a_damped_pendulum_comes_to_rest",
        ),
        (
            "change <= «2→1e8» * _EPS * size",
            "test_coming_to_rest.py::test_settled_velocities_are_those_of_the_implicit_equation",
        ),
        (
            "return «2.0 * math.sinh(0.5 * friction * h) / friction→h»",
            "test_friction.py::test_a_body_sinks_as_fast_as_it_should_however_strong_the_friction",
        ),
    ],
    "solvers/sparse/row_values.py": [
        (
            "time = «0.5 * (time + load_double(parameters, 1)→load_double(parameters, 0»)",
            "test_flights.py::test_driven_velocities_hold_at_the_middle_of_the_time",
        ),
    ],
    "solvers/general_clusters.py": [
        (
            "self.subset.jacobian(«0.5 * (self.start + end)→end», self.time)",
            "test_row_functions.py::test_rows_of_velocities_agree_with_the_dense_solver[KnifeEdge-flight]",
        ),
    ],
    "constraints/velocity.py": [
        ("half = «→-»0.5 * (bx * gx", "test_row_functions.py::test_gradients_of_rows_of_velocities[KnifeEdge]"),
    ],
    "steppers/program.py": [
        (
            "kick.fraction, group, time, «end→1.0»\n",
            "test_langevin.py::test_each_substep_meets_targets_at_its_own_time",
        ),
        (
            'row.name == "evaluate"« and row.here == 1→»',
            "test_interpreter.py::test_kicks_in_succession_and_before_other_operations",
        ),
        (
            "«met[verb] += 1→pass»",
            "thermostats/multistep/test_spheres.py::test_noise_is_a_function_of_seed_step_and_part",
        ),
    ],
    "thermostats/monte_carlo.py": [
        (
            "velocities=«-→»begin.velocities)",
            "test_hamiltonian_monte_carlo.py::test_every_decision_follows_from_the_energies[0.7]",
        ),
        (
            "ACCEPTED if threshold < «-→»change",
            "test_hamiltonian_monte_carlo.py::test_every_decision_follows_from_the_energies[0.0]",
        ),
        (
            "np.sqrt((1 - self.keep«**2→»)",
            "test_hamiltonian_monte_carlo.py::test_velocities_are_those_of_the_temperature",
        ),
        (
            "(1 / kt[k«] - 1 / kt[k + 1→ + 1] - 1 / kt[k»])",
            "test_replica_exchange.py::test_the_rule_and_what_changes_places",
        ),
    ],
    "steppers/reversibility_check.py": [
        (
            "if not residual <«= self.tolerance→ 1e300»:",
            "test_hamiltonian_monte_carlo.py::test_what_cannot_be_taken_back_is_seen",
        ),
    ],
    "thermostats/nose_hoover.py": [
        ("q[0] *= «count→1.0»", "test_nose_hoover.py::test_temperature_oscillates_with_the_period_asked_for"),
        ("if «not state.is_of(system)→False»:", "test_state.py::test_another_system_begins_a_thermostat_anew"),
    ],
    "steppers/operations.py": [
        (
            "nodes = [math.fsum(flat[:k]) for k in range(«1, len(flat))] + [1.0→len(flat))»]",
            "test_listings.py::test_fractions_share_the_step",
        ),
        (
            "done += [Kick(«0.5 * fraction), stage, Settle(0.5 * fraction)→fraction), stage»]",
            "test_listings.py::test_what_is_reversible_is_the_same_backwards",
        ),
    ],
    "thermostats/noise.py": [
        ("«stream[3] += 1.0→pass»", "test_spheres.py::test_noise_is_a_function_of_seed_step_and_part"),
        ("«stream[3] = 0.0→pass»", "test_respa.py::test_each_exchange_of_a_step_has_noise_of_its_own"),
    ],
    "steppers/stages/compiled_operations.py": [
        ("room[FAR] = «1.0 if far else →»0.0", "test_interpreter.py::test_a_march_ends_where_remainders_begin"),
        (
            "            if «pairs→False»:\n                low[:] = 0.0",
            "test_interpreter.py::test_steps_in_kernels_are_those_of_the_engine",
        ),
    ],
    "steppers/files.py": [
        ("if «count != len(archive.namelist())→False»:", "test_state.py::test_a_damaged_byte_is_noticed"),
        (
            "except BaseException:\n        «unfinished.unlink(missing_ok=True)→pass»",
            "test_state.py::test_a_full_disk_leaves_nothing_behind",
        ),
        (
            '{target.name}«.{token_hex(8)}→»{UNFINISHED}"',
            "steppers/test_files.py::test_writers_of_one_path_do_not_meet",
        ),
        (
            "«fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)→pass»",
            "steppers/test_files.py::test_a_folder_is_of_one_run_at_a_time",
        ),
        (
            "        if «wrong→False»:\n            said",
            "steppers/test_files.py::test_a_folder_of_something_else_is_refused",
        ),
        (
            "if «unpacked > length→False»:",
            "steppers/test_files.py::test_an_archive_that_would_unpack_to_more_is_refused",
        ),
    ],
    "steppers/running.py": [
        ("if steps and holds and «state is not system.last→False»:", "test_state.py::test_start_off_the_constraints"),
        (
            "    «refuse_clock(state.time, state.step, state.time_remainder)\n    →»if stepper",
            "test_running.py::test_states_made_by_hand_with_impossible_numbers",
        ),
    ],
    "steppers/state.py": [
        ("return «self.is_of(system) and →»(", "test_state.py::test_forces_of_another_system_are_not_taken"),
        (
            "«(there is here or np.array_equal(there, here))→True»",
            "test_state.py::test_forces_are_kept_at_their_positions_only",
        ),
        ("if «time != self.time or →»(", "test_state.py::test_forces_are_kept_at_their_time_and_velocities_only"),
    ],
    "thermostats/correlated_series.py": [
        (
            "own = rule @ rule + «np.expm1(_LOG_R)→0.0 * _LOG_R» *",
            "test_correlated_series.py::test_errors_are_as_large_as_they_say[memory-3]",
        ),
        (
            "<= «_SMOOTH * →»squares.sum()",
            "test_correlated_series.py::test_errors_are_as_large_as_they_say[smooth]",
        ),
        (
            "for turn in (0.0,« *_OSCILLATORS→»):",
            "test_correlated_series.py::test_errors_are_as_large_as_they_say[underdamped]",
        ),
        (
            "max(«2 * len(values) // 3→len(values)», _FEWEST_COSINES)",
            "test_correlated_series.py::test_errors_are_as_large_as_they_say[up-and-down]",
        ),
        ("if «carriers < FEW_INDEPENDENT→False» else", "test_correlated_series.py::test_heavy_tails_are_said"),
    ],
    "thermostats/freedom.py": [
        ("for k in range(1, «NEARER + 1→2»)", "test_freedom.py::test_bodies_that_feel_another_are_not[gas]"),
    ],
    "thermostats/pressure/barostat.py": [
        (
            "«spread = np.minimum(spread, 0.5 * (strains.most / _WITHIN) ** 2)→pass»",
            "test_cell_rescaling.py::test_noise_of_few_pieces_stays_within_what_a_trial_may_change[anisotropic]",
        ),
    ],
    "thermostats/configurational_temperature.py": [
        ("if «not np.all(miss <= OFF)→False»:", "test_configurational_temperature.py::test_frames_off_the_constraints"),
    ],
    "thermostats/slow_share.py": [
        (
            "«constrained_acceleration(system, there, f, 0.0)→f * system.weights»",
            "test_slow_share.py::test_a_rigid_pair_turns_freely_in_a_trap",
        ),
        ("np.array([name == group, «True→name != group»])", "test_slow_share.py::test_springs_of_free_atoms"),
    ],
    "constraints/arguments.py": [
        ('if «array.dtype.kind == "c"→False»:', "test_arguments.py::test_every_way_in_refuses_them"),
        ("«not 0 <= rng < 2**bits→False»", "test_arguments.py::test_what_is_neither_a_seed_nor_a_generator"),
        ("or «value not in words→False»:", "test_methods.py::test_what_is_wrong_with_a_method_is_said"),
        (
            "for rule in () if «optional and→» value is None else asked:",
            "test_arguments.py::test_none_where_it_is_no_value",
        ),
    ],
    "constraints/periodic/images.py": [
        ("«| (self.item.kind == RowKind.LINEAR)→»", "test_images.py::test_atoms_in_any_image_are_held_as_whole_ones"),
        ("_HALF = 0.«5 - 1e-9→6»", "test_images.py::test_atoms_that_nothing_ties_raise_before_their_image_flips"),
        (
            "cells = «np.round((y_ref - x_ref)[self.atoms] @ lattice[1]) - →-»np.round(step @ lattice[1])",
            "test_images.py::test_atoms_in_any_image_are_held_as_whole_ones",
        ),
        ("BOND_LIKE = «1→0».5", "test_images.py::test_a_polymer_that_closes_through_the_boundary"),
    ],
    "plan/plan.py": [
        ("«eliminate_last[rows[order]] = left_over→pass»", "test_plan.py::test_dependent_rows_are_eliminated_last"),
    ],
    "motion/certificate.py": [
        (
            "SPEED = 1«0.→e1»0",
            "test_certificate.py::test_a_solver_that_is_wrong_without_knowing_is_found_in_the_first_step",
        ),
    ],
    "motion/motion.py": [
        (
            "            «certify(self._given, here, speed, time, slack=10 * MISFIT, still=still, moved=moved)→pass»",
            "test_certificate.py::test_rows_that_were_converted_are_looked_at_as_they_were_given",
        ),
    ],
    "constraints/constraint_set.py": [
        (
            "np.maximum(1e-«10→8» * self.scale, 8 * np.finfo(float).eps",
            "test_certificate.py::test_what_is_allowed_scales_with_rounding",
        ),
    ],
}
