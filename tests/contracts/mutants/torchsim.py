"""TorchSim: slices, drifts, noise, degrees of freedom; they need torch."""

MUTANTS = {
    "torchsim/holding.py": {
        "or any(a is not b «or n != m→»": "torchsim/torchsim_refusals::masses_that_are_edited_in_a_run_are_refused",
        "(torch.cumsum(system_mask, 0) - «1→0»)": "torchsim/torchsim_states::slices_take_the_right_rows_along",
        "dict(zip(«self.system_idx.tolist()→range(len(self.motions))»,": (
            "torchsim/torchsim_states::slices_take_the_right_rows_along"
        ),
        "motions = [«held[k] if k in held else →»_unheld": (
            "torchsim/torchsim_states::systems_with_nothing_held_stay_free"
        ),
        "«batch.check()→pass»": "torchsim/torchsim_optimizers::steps_that_cannot_be_held_are_told",
        "self.system_idx + «system_offset→0»": "torchsim/torchsim_states::splitting_joining_popping_and_copies",
        "state.row_vector_cell «* state.pbc[:, None]→»": "torchsim/torchsim_states::a_periodic_cell",
        "if «not same→False»:": "torchsim/torchsim_refusals::a_state_that_has_become_another_is_refused[masses]",
        "project=«project→True»)": "torchsim/torchsim_refusals::bad_input_is_named_and_leaves_the_state",
    },
    "torchsim/dynamics.py": {
        "away.max() > «FAR→1e9»": "torchsim/torchsim_refusals::a_state_that_has_become_another_is_refused[positions]",
        '«_each(state, dt, "dt", finite_number, True)→0.5 * _each(state, dt, "dt", finite_number, True)»': (
            "torchsim/torchsim_dynamics::constant_energy_is_the_trajectory_of_the_engine"
        ),
        "kT=kT, at_rest=«True→False»)": "torchsim/torchsim_dynamics::momenta_are_drawn_from_the_canonical_distribution",
        "    «rule(extreme, item)→pass»\n": "torchsim/torchsim_refusals::settings_that_are_none_are_refused",
        "- 3 * «_free(self)→1»": "torchsim/torchsim_states::fixed_atoms_stay",
        "held.batch(state)«.check()→»\n    state.positions = positions": (
            "torchsim/torchsim_dynamics::a_failed_step_leaves_the_state"
        ),
        "is not left[0] «or state.positions._version != left[1]→»": (
            "torchsim/torchsim_refusals::positions_that_are_edited_between_steps_are_refused"
        ),
        '«_check_forces(state, output["forces"])→»\n    held.left': (
            "torchsim/torchsim_dynamics::forces_that_are_not_finite_are_named[nve]"
        ),
        "step(«copy.copy(state)→state», model": "torchsim/torchsim_dynamics::a_failed_step_leaves_the_state",
    },
}
