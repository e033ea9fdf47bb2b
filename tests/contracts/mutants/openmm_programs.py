"""Mutants of what OpenMM runs."""

MUTANTS = {
    "openmm/integrator/guard.py": {
        "if «cut.any()→False»:": (
            "hold::a_barostat_in_place_of_another_force_refuses_rows_through_the_faces_of_the_box"
        ),
        "«self._read_again()→»  # `Context": "openmm/integrator/edits::particles_that_lose_their_mass_take_no_heat",
        "if (self.thermal «or self._freedom→»)": "openmm/integrator/edits::particles_that_lose_their_mass_take_no_heat",
        "            if «self._read_again()→False»:\n": (
            "openmm/integrator/edits::masses_and_lengths_after_reinitialize"
        ),
        "if not sites or «integrator.program.on_device→False»:": "device_integrator::virtual_sites_follow",
        "()._value if «driven→False» else 0.0": "hold::time_that_is_set_is_no_way_of_moving_targets",
        "for part in integrator.parts:\n                «part.check_masses(self.system)→pass»": (
            "callbacks::masses_that_change_in_a_run_are_noticed_at_the_next_check"
        ),
        "if «squares <= self._explosive→not squares > 1e300»:": "steps::an_explosion_is_told_where_its_call_ends",
        '", «precision.name == "single"→False»)': "isokinetic_ensemble::weak_forces_are_not_lost_in_single_precision",
        ".program.recall(«self._memory→{}»)": "nose_hoover_ensemble::a_nan_leaves_the_chain_of_the_last_check",
        "any(«map(knows_a_place, applied)→isinstance(force, openmm.CustomExternalForce) for force in applied»)": (
            "guard::a_motion_remover_meets_complete_velocities_beside_forces_that_know_a_place"
        ),
        "+ «images→[]»": "conserved_momenta::a_motion_remover_takes_momentum_beside_particles_without_mass",
        "«self._left in (None, self._place(context))→True»": "steps::change_of_the_box",
        "except (ConvergenceError, «InputError, →»NonFiniteError) as": (
            "langevin_ensemble::a_force_that_gets_another_group_leaves_the_state_that_was_checked"
        ),
        "rows = replace(rows, «lengths=given, others=given→others=given»)": (
            "system_checks::lengths_of_rigid_water_are_compared_with_those_of_the_system"
        ),
        "«context.setParameter(name, parameters[name])→pass»": (
            "conserved_momenta::forces_are_looked_at_with_the_parameters_of_the_context"
        ),
        "f.getFrequency() > «→100»0]": "system_checks::two_barostats_are_refused",
        "apex = i« if of[j] == of[k] else j if of[j] == sides[j][k] else k→»": (
            "system_checks::triangles_with_unequal_masses_beside_the_apex_are_refused"
        ),
        "(«2 * rows == particles * (particles - 1)→rows >= particles - 1»).all()": (
            "system_checks::rigid_bodies_hold_all_their_distances"
        ),
        "        if «→not rows and »_scales_atoms(force):": "hold::agents_that_break_rows_are_refused",
    },
    "openmm/integrator/program.py": {
        "«*delta(v-{1})→», {0}, v": "reported_kinetic_energy::of_velocities_that_others_have_set_it_is_theirs",
        "v+per_h*(x-xu)«→+0.5*dt*f/m»": "reported_kinetic_energy::with_noise_it_is_that_half_a_kick_before_the_end",
        '«exact+→»1-between != 0", "kicks need it")': "every_ensemble::calls_of_any_length_make_the_same_motion",
        '", "good_steps+«delta(failed)→1»", "count it")': "steps::a_failed_step_is_taken_back_and_not_counted",
        '"failed > 0", "a solve failed"):\n        p.each("x", "x«_last→»"': (
            "steps::a_step_without_a_solution_is_taken_back"
        ),
        'p.each("v", "v«_last→»", "back to where the step began")': "steps::a_step_without_a_solution_is_taken_back",
        '"«select(looked, v_last, u-0.5*dt*f/m)→v_last»"': "steps::failure_where_nobody_looked",
        'middle(p, f"«→v+»(x-x_start)/': "langevin_ensemble::langevin_without_friction_is_the_drift_in_two_halves",
        'kick(p, "«kick→0.5»*dt", tangent': "langevin_ensemble::langevin_without_friction_is_the_drift_in_two_halves",
        'asks = "«select(call-1, failed, select(moved, -1, 0))→failed»"': (
            "openmm/integrator/edits::positions_off_the_rows_are_not_pulled_back_in_silence"
        ),
        '"x and v may have been changed"):\n            with p.when("moved+stale«+abs(call-2)→»': (
            "steps::parameters_of_forces_are_used_in_the_next_step"
        ),
        "self.recall({**self.«settings→idle», **self.idle})": "settings::a_setting_has_a_method_of_its_own",
        "[«-1→0»] += operation.fraction": "langevin_ensemble::langevin_without_friction_is_the_drift_in_two_halves",
    },
    "openmm/ensembles/isokinetic_ensemble.py": {
        "(count« - 1→») * GAS_CONSTANT * self.temperature": "openmm_replay::temperature",
        '"max(qq«-wq→», wq^2/ww)"': "isokinetic_ensemble::two_sums_do_where_velocities_are_not_read",
        'program.set("exact", «float(precision == "double" and not rigid)→0.0»)': (
            "every_ensemble::calls_of_any_length_make_the_same_motion"
        ),
        '"«select(behind, exact, 1)→exact» != 0"': (
            "isokinetic_ensemble::of_velocities_set_between_calls_only_the_direction_counts"
        ),
    },
    "openmm/ensembles/monte_carlo_sampler.py": {
        "if asked is None«→ and False» else": "monte_carlo_sampler::reporters_of_a_simulation_see_every_proposal",
        "if «not missed <= self.tolerance→False»:": "monte_carlo_sampler::a_way_back_that_misses_its_start_is_rejected",
    },
    "constraints/constraint.py": {
        "(target > 0) «& (target < self.below)→»).all(": "families::remedies",
    },
    "constraints/target.py": {
        ".abs(fine - given) > «WRONG→100» * size)": "target::derivatives_that_contradict_a_moving_target_are_refused",
    },
    "topology/rows_by_name.py": {
        "long > «np.minimum(TORN, FAR * radii)→TORN»": "ase/topology::held_by_name",
    },
    "openmm/ensembles/conserved_momenta.py": {
        ", fixed) if «virtual_sites(system)→False»": (
            "conserved_momenta::a_motion_remover_takes_momentum_beside_particles_without_mass"
        ),
        "«FAR→SHIFT» * rng.stand": "conserved_momenta::momenta_that_are_conserved_are_found",
        "«not removed→True»:  #": "conserved_momenta::a_motion_remover_takes_momentum_beside_particles_without_mass",
        "«turns.keep(turns.fields(x[fixed]))→pass»": "conserved_momenta::particles_without_mass_leave_turns_about_them",
        "«turns.keep_rows(motion, x[atoms], time)→pass»": (
            "conserved_momenta::angular_momentum_about_the_axes_of_what_is_held_is_said"
        ),
        ") < _PLACES« or turns.open→»:": "conserved_momenta::angular_momentum_about_the_axes_of_what_is_held_is_said",
        "«turns.keep→»(np.tensordot(": "conserved_momenta::a_motion_remover_leaves_turns_about_the_center_of_mass",
    },
    "openmm/ensembles/langevin_ensemble.py": {
        "«groups_of(force)→{force.getForceGroup()}» - set(known)": (
            "langevin_ensemble::forces_in_reciprocal_space_have_a_number_of_steps_too"
        ),
        "sqrt(«2*→»kT*kept_share*sinh(friction*{h}))": "openmm_replay::temperature",
    },
    "openmm/ensembles/nose_hoover_ensemble.py": {
        '(name, «f"{name}_last"→name», "the': "nose_hoover_ensemble::a_step_that_fails_leaves_the_chain_where_it_was",
    },
    "openmm/ensembles/spheres_ensemble.py": {
        "if «self.steps is not None→False»:\n            refuse_other_groups(integrator, integrator.context": (
            "langevin_ensemble::a_force_that_gets_another_group_leaves_the_state_that_was_checked"
        ),
    },
    "openmm/integrator/projected.py": {
        "        «→# »self._write()  # the same": "settings::integrators_in_turn_hold_the_same_part",
    },
    "openmm/collective/collective_rows.py": {
        "«context.applyVelocityConstraints→print»(context.get": (
            "collective_rows::restore_keeps_the_constraints_of_other_molecules"
        ),
        "(*held[:k], *«held[n:]→()») for k": "collective_rows::rows_without_a_direction_of_their_own_are_named",
        "weight{c}*({of('more', i)}«-→+»{of('expected', i)})": "row_program::the_iteration_learns_from_each_push",
        'let(f"back{c}_{i}_{j}", f"«-→»({done})*back{c}_{i}_{i}"': "row_program::the_iteration_learns_from_each_push",
        'again = f"select({sure}, «3→1», 1)"': "row_program::many_steps_look_less_often",
        '"«min(stage, 1)*→»" if p.halves': "row_program::what_a_bath_does_across_a_row_is_no_work",
        '"«*(1+stage)→»" if p.halves': "row_program::what_a_bath_does_across_a_row_is_no_work",
    },
    "openmm/surface_integrator.py": {
        "«positions is None→False»:": (
            "surface_integrator::a_particle_at_the_center_is_refused_and_one_far_from_the_origin_is_held"
        ),
    },
    "openmm/callback_rows.py": {
        "if «self._thread not in (0, get_ident())→False»:": "hold::rows_serve_one_thread_at_a_time",
        "«self.refuse_other_threads()→»\n        self.exact": "hold::rows_serve_one_thread_at_a_time",
        "if self._count == count + «1 > 0→2 > 0»:": "callbacks::an_integrator_that_does_not_hold_the_rows_is_refused",
        "elif self.timed and «self._integrator() is None→False»:": (
            "callbacks::rows_that_need_the_time_are_not_held_without_their_integrator"
        ),
        "= «not p.integrator.thermostatted→False»": "hold::velocities_are_those_of_the_core",
        "self._«engine.stand_at(self._state(context)[0])→state(context)[0]»": (
            "settings::integrators_in_turn_hold_the_same_part"
        ),
        "u * np.cos(w) - d * (w * np.sin(w))« - way→»": "surface_integrator::great_circles_at_any_time_step",
        '"ij,ij->i", d, way)[:, None] / radius«**2→»)': "surface_integrator::the_steps_are_those_of_the_core",
        "self.motion.rank - «3→0» * int": "hold::particles_without_mass_take_no_degree_of_freedom",
    },
}
