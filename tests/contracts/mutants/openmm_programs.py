"""Mutants of what OpenMM runs."""

MUTANTS = [
    # -- programs for OpenMM --
    (
        "openmm/integrator/guard.py",
        "if squares <= self._explosive:",
        "if not squares > 1e300:",
        "tests/openmm/integrator/states/test_calls.py::test_an_explosion_is_told_where_its_call_ends",
    ),
    (
        "openmm/integrator/step_writer.py",
        "u=select(spread*delta(v-v_end), v_middle, v)",
        "u=select(spread, v_middle, v)",
        "tests/openmm/ensembles/test_reported_kinetic_energy.py::test_of_velocities_that_others_have_set_it_is_theirs",
    ),
    (
        "openmm/integrator/step_writer.py",
        'self._note_middle("v+per_h*(x-xu)")',
        'self._note_middle("v+per_h*(x-xu)+0.5*dt*f/m")',
        "tests/openmm/ensembles/test_reported_kinetic_energy.py"
        "::test_with_noise_the_temperature_of_the_bath_is_reported",
    ),
    (
        "openmm/integrator/rattle_integrator.py",
        "guard.count(block, ends=ends.spare and not steps and not goes_on)",
        "guard.count(block)",
        "tests/openmm/integrator/test_rattle_integrator.py::test_the_ends_of_calls_are_checked",
    ),
    (
        "openmm/integrator/states/settings.py",
        "differing = self.program.differing()",
        "differing = []",
        "openmm_runs.py::test_a_setting_that_was_written_by_its_number_is_refused_once",
    ),
    (
        "openmm/integrator/system_checks.py",
        "if force.getFrequency() > 0]",
        "if force.getFrequency() > 1000]",
        "tests/openmm/integrator/test_system_checks.py::test_two_barostats_are_refused",
    ),
    (
        "openmm/ensembles/isokinetic_ensemble.py",
        '"max(qq-wq, wq^2/ww)"',
        '"max(qq, wq^2/ww)"',
        "tests/openmm/ensembles/test_isokinetic_ensemble.py::test_two_sums_do_where_velocities_are_not_read",
    ),
    (
        "openmm/ensembles/isokinetic_ensemble.py",
        'program.write("exact", float(precision == "double" and not rigid))',
        'program.write("exact", 0.0)',
        "tests/openmm/ensembles/test_isokinetic_ensemble.py::test_calls_of_any_length_make_the_same_motion",
    ),
    (
        "openmm/ensembles/isokinetic_ensemble.py",
        '"select(behind, exact, 1) != 0"',
        '"exact != 0"',
        "tests/openmm/ensembles/test_isokinetic_ensemble.py::test_of_velocities_set_between_calls_only_the_direction_counts",
    ),
    (
        "constraints/constraint.py",
        "if self.squared and not (target > 0).all():",
        "if not self.squared and not (target > 0).all():",
        "tests/constraints/test_target.py::test_a_distance_that_moves_below_zero_is_refused_there",
    ),
    (
        "constraints/target.py",
        "(np.abs(fine - given) > WRONG * size)",
        "(np.abs(fine - given) > 100 * size)",
        "tests/constraints/test_target.py::test_derivatives_that_contradict_a_moving_target_are_refused",
    ),
    (
        "ase/topology.py",
        "if guessed and said != stamp:",
        "if not guessed and said != stamp:",
        "tests/ase/test_topology.py::test_guessed_bonds_are_guessed_anew_for_sorted_and_cut_atoms",
    ),
    (
        "topology/rows_by_name.py",
        "long > np.minimum(TORN, FAR * radii)",
        "long > TORN",
        "tests/ase/test_topology.py::test_bonds_that_are_far_too_long_are_not_held",
    ),
    (
        "openmm/ensembles/conserved_momenta.py",
        "if not removed:  # what a remover takes",
        "if True:  # what a remover takes",
        "tests/openmm/ensembles/test_conserved_momenta.py::"
        "test_a_motion_remover_takes_momentum_beside_particles_without_mass",
    ),
    (
        "openmm/integrator/guard.py",
        'write("coarse", float(self.constraints.precision.name == "single"))',
        'write("coarse", 0.0)',
        "tests/openmm/ensembles/test_isokinetic_ensemble.py::test_weak_forces_are_not_lost_in_single_precision",
    ),
    (
        "openmm/integrator/system_checks.py",
        "apex = i if of[j] == of[k] else j if of[j] == sides[j][k] else k",
        "apex = i",
        "tests/openmm/integrator/test_system_checks.py::test_triangles_with_unequal_masses_beside_the_apex_are_refused",
    ),
    (
        "openmm/ensembles/respa_ensemble.py",
        "groups_of(force) - set(self.groups)",
        "{force.getForceGroup()} - set(self.groups)",
        "tests/openmm/ensembles/test_respa_ensemble.py::test_forces_in_reciprocal_space_have_a_number_of_steps_too",
    ),
    (
        "openmm/integrator/lean_step_writer.py",
        'p.when("exact+1-between != 0", "kicks need it")',
        'p.when("1-between != 0", "kicks need it")',
        "tests/openmm/ensembles/test_isokinetic_ensemble.py::test_calls_of_any_length_make_the_same_motion",
    ),
    (
        "openmm/integrator/system_checks.py",
        "(2 * rows == particles * (particles - 1)).all()",
        "(rows >= particles - 1).all()",
        "tests/openmm/integrator/test_system_checks.py::test_rigid_bodies_hold_all_their_distances",
    ),
    (
        "openmm/integrator/step_writer.py",
        'p.let("good_steps", "good_steps+delta(failed)", "count it")',
        'p.let("good_steps", "good_steps+1", "count it")',
        "tests/openmm/integrator/test_step_writer.py::test_a_step_whose_last_projection_fails_is_not_counted",
    ),
    (
        "openmm/integrator/step_writer.py",
        'p.each("x", "x_last", "back to where the step began")',
        'p.each("x", "x", "back to where the step began")',
        "tests/openmm/collective/test_collective_rows.py::test_a_step_too_large_is_taken_back",
    ),
    (
        "openmm/integrator/step_writer.py",
        'p.each("v", "v_last", "back to where the step began")',
        'p.each("v", "v", "back to where the step began")',
        "tests/openmm/collective/test_collective_rows.py::test_a_step_too_large_is_taken_back",
    ),
    (
        "openmm/integrator/step_writer.py",
        "u=v+0.5*dt*f/m+0.5*impulse",
        "u=v+0.5*dt*f/m",
        "tests/openmm/integrator/test_lean_step_writer.py::test_leapfrog_at_rest_has_no_kinetic_energy",
    ),
    (
        "openmm/integrator/lean_step_writer.py",
        '"select(looked, v_last, u-0.5*dt*f/m)"',
        '"v_last"',
        "tests/openmm/integrator/test_lean_step_writer.py::test_failure_where_nobody_looked",
    ),
    (
        "openmm/integrator/lean_step_writer.py",
        'ensemble.middle(p, f"(x-x_start)/{h}", lambda: None)',
        'ensemble.middle(p, f"v+(x-x_start)/{h}", lambda: None)',
        "tests/openmm/ensembles/test_langevin_ensemble.py::test_langevin_without_friction_is_the_drift_in_two_halves",
    ),
    (
        "openmm/integrator/lean_step_writer.py",
        'self._kicked("kick*dt", tangent=True, unseen=True)',
        'self._kicked("0.5*dt", tangent=True, unseen=True)',
        "tests/openmm/ensembles/test_langevin_ensemble.py::test_langevin_without_friction_is_the_drift_in_two_halves",
    ),
    (
        "openmm/ensembles/nose_hoover_ensemble.py",
        'program.let(name, _before(name), "the chain is back where the step began")',
        'program.let(name, name, "the chain is back where the step began")',
        "tests/openmm/ensembles/test_nose_hoover_ensemble.py::test_a_step_that_fails_leaves_the_chain_where_it_was",
    ),
    (
        "openmm/integrator/guard.py",
        "self.integrator.program.recall(self._memory)",
        "self.integrator.program.recall({})",
        "tests/openmm/ensembles/test_nose_hoover_ensemble.py::test_a_nan_leaves_the_chain_of_the_last_check",
    ),
    (
        "openmm/ensembles/langevin_ensemble.py",
        "sqrt(2*kT*kept_share*sinh(friction*dt))",
        "sqrt(kT*kept_share*sinh(friction*dt))",
        "tests/openmm/ensembles/test_langevin_ensemble.py",
    ),
    (
        "openmm/collective/row_program.py",
        "weight{c}*({of('more', i)}-{of('expected', i)})",
        "weight{c}*({of('more', i)}+{of('expected', i)})",
        "tests/openmm/collective/test_row_program.py::test_the_iteration_learns_from_each_push",
    ),
    (
        "openmm/collective/row_program.py",
        'p.let(f"back{c}_{i}_{j}", f"-({done})*back{c}_{i}_{i}"',
        'p.let(f"back{c}_{i}_{j}", f"({done})*back{c}_{i}_{i}"',
        "tests/openmm/collective/test_row_program.py::test_the_iteration_learns_from_each_push",
    ),
    (
        "openmm/collective/row_program.py",
        "select(follows{c}, 2*{self._of('last', k)}-{self._of('older', k)}, 0)",
        "0*follows{c}",
        "tests/openmm/collective/test_row_program.py::test_many_steps_look_less_often",
    ),
    (
        "openmm/surfaces/surface_step_writer.py",
        '"select(behind, 1, kick_share(first_stage))"',
        '"kick_share(first_stage)"',
        "tests/openmm/surfaces/test_surface_step_writer.py",
    ),
    (
        "openmm/surfaces/surface_step_writer.py",
        '"select(failed, 0.5*behind, kick_share(stage))"',
        '"kick_share(stage)"',
        "tests/openmm/surfaces/test_surface_integrator.py::test_a_first_step_without_solution_leaves_velocities_without_a_kick",
    ),
    (
        "openmm/integrator/schemes.py",
        "            kicks[-1] += operation.fraction",
        "            kicks[0] += operation.fraction",
        "tests/openmm/integrator/test_schemes.py",
    ),
    (
        "openmm/integrator/projected.py",
        "                part.serve(self, notes)\n",
        "",
        "tests/openmm/integrator/test_part.py::test_integrators_in_turn_hold_the_same_part",
    ),
    (
        "openmm/integrator/system_checks.py",
        "if rows and any(_scales_atoms",
        "if not rows and any(_scales_atoms",
        "tests/openmm/integrator/test_projected.py::test_barostat_and_rows_between_molecules",
    ),
    (
        "openmm/ensembles/conserved_momenta.py",
        "context.setParameter(name, given.getParameter(name))",
        "pass",
        "tests/openmm/ensembles/test_conserved_momenta.py"
        "::test_forces_are_looked_at_with_the_parameters_of_the_context",
    ),
    (
        "openmm/ensembles/conserved_momenta.py",
        "turns.keep(turns.fields(x[fixed]))",
        "pass",
        "tests/openmm/ensembles/test_conserved_momenta.py::test_particles_without_mass_leave_turns_about_them",
    ),
    (
        "openmm/ensembles/conserved_momenta.py",
        "turns.keep_rows(motion, places)",
        "pass",
        "tests/openmm/ensembles/test_conserved_momenta.py"
        "::test_angular_momentum_about_the_axes_of_what_is_held_is_said",
    ),
    (
        "openmm/ensembles/conserved_momenta.py",
        "while len(found) < _PLACES or turns.open:",
        "while len(found) < _PLACES:",
        "tests/openmm/ensembles/test_conserved_momenta.py"
        "::test_angular_momentum_about_the_axes_of_what_is_held_is_said",
    ),
    (
        "openmm/ensembles/conserved_momenta.py",
        "turns.keep(np.tensordot(",
        "(np.tensordot(",
        "tests/openmm/ensembles/test_conserved_momenta.py::test_a_motion_remover_leaves_turns_about_the_centre_of_mass",
    ),
    (
        "openmm/integrator/guard.py",
        "any(map(knows_a_place, applied))",
        "any(isinstance(force, openmm.CustomExternalForce) for force in applied)",
        "tests/openmm/integrator/test_guard.py"
        "::test_a_motion_remover_meets_complete_velocities_beside_forces_that_know_a_place",
    ),
    (
        "openmm/integrator/projected.py",
        "            part.forget()\n",
        "",
        "tests/openmm/surfaces/test_surface_rows.py::test_parts_that_are_compiled_go_where_the_others_go",
    ),
    (
        "openmm/surfaces/closed_forms.py",
        "super()._declare_solution(p)",
        "super()",
        "tests/openmm/surfaces/test_surface_rows.py::test_parts_that_are_compiled_go_where_the_others_go",
    ),
    (
        "openmm/collective/row_program.py",
        'clock_of(variables_of(before), notes["code"])',
        "0.0",
        "tests/openmm/collective/test_row_program.py::test_members_of_a_compound_integrator_pull_in_turn",
    ),
    (
        "openmm/callback_rows/carried_constraints.py",
        "self._engine.stand_at(self._state(context)[0])",
        "self._state(context)[0]",
        "openmm_runs.py::test_a_run_goes_on_bit_for_bit",
    ),
    (
        "openmm/callback_rows/carried_constraints.py",
        "return self.motion.rank - 3 * fixed",
        "return self.motion.rank",
        "tests/openmm/callback_rows/test_carried_constraints.py::test_particles_without_mass_take_no_degree_of_freedom",
    ),
]
