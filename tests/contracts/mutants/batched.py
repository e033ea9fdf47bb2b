"""Batches on PyTorch: iterations, derivatives, elimination by levels, images, failures; they need torch."""

MUTANTS = {
    "batched/clusters.py": {
        "torch.where(d > «0→-9e99», 0.0, torch.inf)": "batched/batch::a_bond_that_has_turned_is_no_solution",
        "_each(operator.«neg→pos», self.spread(slope, a)": "batched/gradients::derivatives_are_those_of_the_solution",
        "start=of.start «+→-» moved)": "batched/gradients::derivatives_are_those_of_the_solution[lanes-blade]",
        "(d @ d.mT, «lam→2 * lam».T": "batched/against_the_engine::chains_and_rows_that_depend_on_others",
        "(0, numbers, terms, alpha=«-1→1»)": "batched/against_the_engine::chains_and_rows_that_depend_on_others",
        "return value«.item() if isinstance(value, np.ndarray) else value→»": (
            "batched/against_the_engine::families_are_held_as_the_engine_holds_them[lanes-Custom-array]"
        ),
    },
    "batched/batch.py": {
        "if «not n→False»:": "batched/batch::constraints_of_no_rows_hold_nothing",
        "sums = «-→+»torch.round(": "batched/against_the_engine::rows_take_the_images_that_the_engine_takes",
        "«group.worst→size», size / group.scale": "batched/batch::a_failure_names_copy_and_row_when_it_is_looked_for",
        "«worst <= ENOUGH→not worst > ENOUGH» *": "batched/batch::a_failure_names_copy_and_row_when_it_is_looked_for",
        "x.shape «in self._shapes→[-1:] == (3,)» and": "batched/batch::what_is_refused",
        "if «getattr(self, item) is not own or own._version→False»:": "batched/batch::what_is_refused",
        "torch.where(self._is_position, held, «flight→1.0» * held)": (
            "batched/against_the_engine::families_are_held_as_the_engine_holds_them[lanes-VelocityFormula-driven]"
        ),
    },
    "batched/steps.py": {
        "if «given.shape != x.shape→False»:": "batched/batch::what_is_refused",
        "(h «+ (h == 0)→»)": "batched/batch::what_is_refused",
        "v + «push→0.5 * push»": "batched/batch::rattle_is_that_of_the_engine_and_reversible",
        "(1 - kept * «kept→1»)": "batched/batch::langevin_keeps_the_temperature_of_the_degrees_of_freedom",
    },
}
