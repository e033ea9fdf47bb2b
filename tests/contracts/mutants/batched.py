"""Batches on PyTorch: iterations, derivatives, elimination by levels, images, failures; they need torch."""

ENGINE, BATCH, GRADIENTS = (
    "batched/test_" + name + ".py::test_" for name in ("against_the_engine", "batch", "gradients")
)

MUTANTS = {
    "batched/clusters.py": [
        ("torch.where(d > «0→-9e99», 0.0, torch.inf)", BATCH + "a_bond_that_has_turned_is_no_solution"),
        (
            "back = _each(operator.«neg→pos», self.spread(slope, a))",
            GRADIENTS + "derivatives_are_those_of_the_solution",
        ),
        ("start=of.start «+→-» moved)", GRADIENTS + "derivatives_are_those_of_the_solution[lanes-blade]"),
        ("d, rest), «rest.T→0 * rest.T»])", ENGINE + "chains_and_rows_that_depend_on_others"),
    ],
    "batched/levels.py": [
        (
            "s.index_add_(0, taken, factor[which] * s[beside], alpha=«-1→1»)",
            ENGINE + "chains_and_rows_that_depend_on_others",
        ),
    ],
    "batched/groups.py": [
        (
            "sums = «-→+»torch.round(",
            ENGINE + "rows_take_the_images_that_the_engine_takes",
        ),
    ],
    "batched/projections.py": [
        (
            "torch.maximum(«group.worst→size», size / group.scale)",
            BATCH + "a_failure_names_copy_and_row_when_it_is_looked_for",
        ),
    ],
    "batched/row_functions.py": [
        (
            "(found * places[«self.width :→: self.width»]).sum()",
            ENGINE + "families_are_held_as_the_engine_holds_them[lanes-CustomVelocity]",
        ),
    ],
    "batched/batch.py": [
        ("if «getattr(self, item)._version→False»:", BATCH + "what_is_refused"),
        (
            "torch.where(self._is_position, held, «flight→1.0» * middle)",
            ENGINE + "families_are_held_as_the_engine_holds_them[lanes-LinearVelocity]",
        ),
    ],
    "batched/steps.py": [
        ("if «given.shape != x.shape→False»:", BATCH + "what_is_refused"),
        ("v + found.push / «h→(2 * h)»", BATCH + "rattle_is_that_of_the_engine_and_reversible"),
    ],
}
