"""TorchSim: slices, drifts, noise, degrees of freedom; they need torch."""

STATES, DYNAMICS, REFUSALS = (
    "torchsim/test_torchsim_" + name + ".py::test_" for name in ("states", "dynamics", "refusals")
)

MUTANTS = {
    "torchsim/constraints_object.py": [
        (
            "if self._made is None or any(a is not b «or n != m→»",
            REFUSALS + "masses_that_are_edited_in_a_run_are_refused",
        ),
        ("(torch.cumsum(system_mask, 0) - «1→0»)", STATES + "slices_take_the_right_rows_along"),
        (
            "for k in torch.«argsort(self.system_idx)→arange(len(self.motions))»",
            STATES + "slices_take_the_right_rows_along",
        ),
        ("new.index_copy(0, atoms, «positions→new[atoms]»)", STATES + "systems_with_nothing_held_stay_free"),
        ("self.system_idx + «system_offset→0»", STATES + "splitting_joining_popping_and_copies"),
    ],
    "torchsim/holding.py": [
        ("if excess[row] > «1→1e9»", REFUSALS + "bad_input_is_named_and_leaves_the_state"),
        ("[FixedAtoms(fixed)] if «len(fixed)→False»", STATES + "fixed_atoms_are_taken_over"),
    ],
    "torchsim/dynamics.py": [
        ("if bool(away.max() > «FAR→1e9»)", REFUSALS + "a_state_that_has_become_another_is_refused[positions]"),
        ("state.momenta + masses * push / «dt→(2 * dt)»", DYNAMICS + "constant_energy_is_the_trajectory_of_the_engine"),
        ("(1 - keep**«2→1»)", DYNAMICS + "short_runs_have_the_temperature_of_the_bath[langevin]"),
        ("- 3 * «_free(self)→1»", STATES + "fixed_atoms_are_taken_over"),
        ("state.__dict__.update(«before→{}»)", DYNAMICS + "a_failed_step_leaves_the_state"),
    ],
}
