"""Mutants of steppers, thermostats, images and certificates."""

MUTANTS = {
    "motion/solver_sequence.py": {
        "«np.copyto(velocities, saved[1])→pass»\n            if isinstance(error": (
            "motion::velocities_are_put_back_when_a_later_solver_fails"
        ),
        "«0.5 * (reference_time + time)→reference_time»": "schemes::flights_are_those_of_dense_algebra",
    },
    "steppers/interpreter.py": {
        "=self.at(row.«begin→end»)": "schemes::flights_are_those_of_dense_algebra",
        "if «held.lattice is not cell or given.lattice is not cell→False»:": (
            "interpreter::a_cell_that_the_force_function_changes"
        ),
        "self.time + «(until * dt + self.left_over)→until * dt»": "interpreter::times_within_a_step_are_exact",
        "self.made += 1«\n        self.number += 1→»": "interpreter::errors_name_the_step",
        "array.setflags(«False→True»)": "state::states_are_changed_by_replace_only",
        "«and kept[2] == known→»": "interpreter::a_temperature_that_is_changed_between_steps_counts_at_once",
        "«if self.low is not None:\n                    self.low.fill(0.0)\n                →»self._next_step()": (
            "interpreter::steps_in_kernels_are_those_of_the_engine"
        ),
        "self.time + «(end * self.dt + self.left_over)→end * self.dt»": "interpreter::times_within_a_step_are_exact",
        "(«start, float(np.abs(push).max(initial=0.0)), →0.0, »": "coming_to_rest::a_damped_pendulum_comes_to_rest",
        "change <= «2→1e8» * EPS * size": "coming_to_rest::settled_velocities_are_those_of_the_implicit_equation",
    },
    "solvers/sparse/mixed_rows.py": {
        "time = «0.5 * (time + load_double(parameters, 1)→load_double(parameters, 0»)": (
            "schemes::flights_are_those_of_dense_algebra"
        ),
    },
    "solvers/general_clusters.py": {
        "subset.jacobian(«0.5 * (start + state)→state», middle)": (
            "row_functions::rows_of_velocities_agree_with_the_dense_solver[blade-flight]"
        ),
    },
    "constraints/functions/formula.py": {
        '[f"{part} «+→-» 0.5*{bent}"': "row_functions::rows_of_velocities_agree_with_the_dense_solver[blade-flight]",
    },
    "thermostats/monte_carlo.py": {
        "velocities=«-→»begin.velocities)": "monte_carlo::every_decision_follows_from_the_energies[0.7]",
        "ACCEPTED if threshold < «-→»": "monte_carlo::every_decision_follows_from_the_energies[0.0]",
        "np.sqrt((1 - self.keep«**2→»)": "monte_carlo::every_decision_follows_from_the_energies[0.7]",
        "(1 / kt[k«] - 1 / kt[k + 1→ + 1] - 1 / kt[k»])": "monte_carlo::the_rule_and_what_changes_places",
    },
    "thermostats/nose_hoover.py": {
        "q[0] *= «count→1.0»": "nose_hoover::temperature_oscillates_with_the_period_asked_for",
        "if «not state.is_of(system)→False»:": "state::another_system_begins_a_thermostat_anew",
    },
    "steppers/operations.py": {
        "kick.fraction, group, time, «end→1.0»": "langevin::each_substep_meets_targets_at_its_own_time",
        'row.name == "evaluate"« and row.here == 1→»': "interpreter::kicks_in_succession_and_before_other_operations",
        "«met[verb] += 1→pass»": "isokinetic_spheres::noise_is_a_function_of_seed_step_and_part",
        "math.fsum(flat[:k]) for k in range(«1, len(flat))] + [1.0→len(flat))»": "listings::fractions_share_the_step",
        "done += [Kick(«0.5 * fraction), stage, Settle(0.5 * fraction)→fraction), stage»]": (
            "listings::what_is_reversible_is_the_same_backwards"
        ),
    },
    "thermostats/noise.py": {
        "«stream[3] += 1.0→pass»": "isokinetic_spheres::noise_is_a_function_of_seed_step_and_part",
        "«stream[3] = 0.0→pass»": "langevin::each_exchange_of_a_step_has_noise_of_its_own",
    },
    "steppers/compiled_operations.py": {
        "room[FAR] = «1.0 if far else →»0.0": "interpreter::a_march_ends_where_remainders_begin",
        "            if «pairs→False»:": "interpreter::steps_in_kernels_are_those_of_the_engine",
    },
    "steppers/files.py": {
        "if «sha256(content).digest() != checksum→False»:": "state::a_damaged_byte_is_noticed",
        "«unfinished.unlink(missing_ok=True)→pass»": "steppers/files::a_file_is_there_once_it_is_whole",
        '{target.name}«.{token_hex(8)}→»{UNFINISHED}"': "steppers/files::writers_of_one_path_do_not_meet",
        "«fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)→pass»": "steppers/files::a_folder_is_of_one_run_at_a_time",
        "        if «wrong→False»:": "steppers/files::a_folder_of_something_else_is_refused",
        "«left.unlink(missing_ok=True)→pass»": "steppers/files::a_run_that_was_killed_leaves_a_folder_to_the_next",
    },
    "steppers/running.py": {
        "if steps and holds and «state is not system.last→False»:": "state::start_off_the_constraints",
        "    «refuse_clock(state.time, state.step, state.time_remainder)\n    →»stepper = Rattle": (
            "state::states_made_by_hand_with_impossible_numbers"
        ),
    },
    "steppers/state.py": {
        "State(x, v, time)«.read_only()→»": "state::states_are_changed_by_replace_only",
        "self.weights.setflags(write=«False→True»)": "state::states_are_changed_by_replace_only",
        "return «self.is_of(system) and →»(": "state::forces_of_another_system_are_not_taken",
        "«(there is here or np.array_equal(there, here))→True»": "state::forces_are_kept_at_their_positions_only",
        "if «time != self.time or →»(": "state::forces_are_kept_at_their_time_and_velocities_only",
    },
    "thermostats/correlated_series.py": {
        "@ rule + «np.expm1(_LOG_R)→0.0 * _LOG_R» *": "correlated_series::errors_are_as_large_as_they_say[memory-3]",
        "<= «_SMOOTH * →»squares.sum()": "correlated_series::errors_are_as_large_as_they_say[smooth]",
        "for turn in (0.0,« *_OSCILLATORS→»):": "correlated_series::errors_are_as_large_as_they_say[underdamped]",
        "max(«2 * len(values) // 3→len(values)»,": "correlated_series::errors_are_as_large_as_they_say[up-and-down]",
        "if «carriers < _FEW_BLOCKS→False» else": "correlated_series::heavy_tails_are_said",
        "_FEW_BLOCKS = 32, «15→10», 10": "correlated_series::few_independent_values_are_said",
    },
    "thermostats/freedom.py": {
        "x = positions + ways[0] «- ways[1]→+ shake - ways[0]»": "freedom",
        "for k in range(1, «NEARER + 1→2»)": "freedom::bodies_that_feel_no_other_are_warned_of_once[gas]",
        'configurations. Use Langevin": «few→False»,': "isokinetic::one_degree_of_freedom",
    },
    "thermostats/barostats.py": {
        "«spread = np.minimum(spread, 0.5 * (strains.most / _WITHIN) ** 2)→pass»": (
            "barostat::noise_of_few_pieces_stays_within_what_a_trial_may_change[anisotropic]"
        ),
    },
    "thermostats/configurational_temperature.py": {
        "if «not np.all(miss <= OFF)→False»:": "configurational_temperature::frames_off_the_constraints",
        "«constrained_acceleration(system, there, f, 0.0)→f * system.weights»": (
            "configurational_temperature::a_rigid_pair_turns_freely_in_a_trap"
        ),
        "np.array([name == group, «True→name != group»])": "configurational_temperature::springs_of_free_atoms",
    },
    "constraints/arguments.py": {
        'if «array.dtype.kind == "c"→False»:': "arguments::every_way_in_refuses_them",
        "«not 0 <= rng < 2**bits→False»": "arguments::what_is_neither_a_seed_nor_a_generator",
        "or «value not in words→False»:": "methods::what_is_wrong_with_a_method_is_said",
        "for rule in () if «optional and→» value is None else asked:": "contracts/refusals::refused",
    },
    "constraints/periodic/images.py": {
        "«| (self.item.kind == RowKind.LINEAR)→»": "images::atoms_in_any_image_are_held_as_whole_ones",
        "cells = «np.round((y_ref - x_ref)[self.atoms] @ lattice[1]) - →-»np.round(step @ lattice[1])": (
            "images::atoms_in_any_image_are_held_as_whole_ones"
        ),
        "BOND_LIKE = «1→0».5": "images::a_polymer_that_closes_through_the_boundary",
    },
    "plan/plan.py": {
        "plan.eliminate_last[rows] = «~→0 * »independent_rows": "plan::dependent_rows_are_eliminated_last",
    },
    "solvers/rank_revealing.py": {
        "«independent→np.isfinite»(diagonal)": "plan::rank_is_that_of_the_dense_matrix",
    },
    "motion/certificate.py": {
        "SPEED = 1«0.→e1»0": "certificate::a_solver_that_is_wrong_without_knowing_is_found_in_the_first_step",
    },
    "steppers/splitting.py": {
        "if «system.velocity_dependent and self.order > 2 and→False and»": "contracts/refusals::refused",
        "« and self.kicks != _rattle_kicks(self.drifts)→»:": "schemes::forces_that_depend_on_velocities_are_taken_back",
    },
    "motion/motion.py": {
        "            «certify(self._given, here, speed, time, slack=10 * MISFIT, still=still, moved=moved)→pass»": (
            "certificate::rows_that_were_converted_are_looked_at_as_they_were_given"
        ),
        "if «self._uneven→False»:": "motion::accelerations_of_a_light_atom_are_on_the_rows_to_their_own_rounding",
    },
    "constraints/constraint_set.py": {
        "_HALF = 0.«5 - 1e-9→6»": "images::atoms_that_nothing_ties_raise_before_their_image_flips",
        "np.maximum(1e-«10→8» * self.scale, 8 * np.finfo(float)": "certificate::what_is_allowed_scales_with_rounding",
        "self.masses = «read_only(m)→m»": "constraint_set::masses_cannot_be_changed",
        "extent(«x[np.isfinite(x).all(axis=1)]→x») or 1.0": (
            "constraint_set::scale_is_the_length_held_or_one_radian_or_the_size_of_the_positions"
        ),
        "«read_only(self.masses)→pass»  # a copy": "constraint_set::masses_cannot_be_changed",
    },
}
