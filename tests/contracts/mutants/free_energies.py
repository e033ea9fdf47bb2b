"""Mutants of scans and free energies."""

MUTANTS = [
    # -- relaxed scans --
    (
        "free_energy/scans/relaxed_scan.py",
        "attempt.energy < best[point].energy:",
        "attempt.energy > best[point].energy:",
        "tests/free_energy/scans/test_relaxed_scan.py::test_both_ways_find_the_lower_of_two_minima",
    ),
    (
        "free_energy/scans/relaxed_scan.py",
        "if with_it.rank != rank + n + 1:",
        "if False:",
        "tests/free_energy/test_refusals.py::test_refusals",
    ),
    (
        "free_energy/scans/relaxation.py",
        "missing = change - size - self._learned(move)",
        "missing = change - size + self._learned(move)",
        "tests/free_energy/scans/test_relaxation.py::test_what_was_learned_goes_along",
    ),
    (
        "free_energy/scans/relaxation.py",
        "return [x[atoms] + images for",
        "return [lined_up(x[atoms], self.lattice) + 0 * images for",
        "tests/free_energy/scans/test_model_hessian.py::test_terms_keep_their_images",
    ),
    (
        "free_energy/scans/scan_result.py",
        "if found is not None and (found.point, found.source) != (point, source):",
        "if found is None and source == point:",
        "tests/free_energy/scans/test_scan_result.py::test_an_attempt_of_another_scan_is_refused",
    ),
    # -- free energies from mean forces and works --
    (
        "free_energy/windows/driver.py",
        "self._failed.pop(job.name, None)",
        "self._failed.clear()",
        "tests/free_energy/windows/test_driver.py::test_windows_that_failed_before_others_are_added_are_still_told_of",
    ),
    (
        "free_energy/windows/driver.py",
        "    finally:\n        os._exit(1)",
        "    finally:\n        pass",
        "tests/free_energy/windows/test_driver.py::test_workers_end_with_what_waits_for_them",
    ),
    (
        "ase/named_calculators.py",
        "if module not in modules:",
        "if False:",
        "tests/ase/test_named_calculators.py::test_files_name_calculators_of_a_list_or_of_modules_that_their_reader_names",
    ),
    (
        "free_energy/torsion_force.py",
        "{*pair} not in joined and bonded.issuperset(pair)",
        "{*pair} not in joined",
        "tests/free_energy/windows/test_ase_windows.py::test_torsions_over_atoms_that_form_no_bonds",
    ),
    (
        "constraints/target.py",
        "    return difference - period * np.round(difference / whole)",
        "    return difference",
        "tests/constraints/functions/test_custom.py::test_differences_where_the_value_jumps_by_its_period"
        " tests/constraints/test_target.py::test_a_target_that_jumps_by_its_period_does_not_move_faster_there",
    ),
    (
        "openmm/integrator/guard.py",
        "        refuse_forgotten_parts(self.system, integrator.row_groups)\n",
        "",
        "tests/openmm/integrator/test_edits.py::test_forgotten_parts_are_refused",
    ),
    (
        "free_energy/averages.py",
        "covariance *= np.outer(widening, widening)",
        "covariance *= 1.0",
        "tests/thermostats/test_correlated_series.py::test_errors_are_as_large_as_they_say",
    ),
    (
        "free_energy/averages.py",
        "return factors[:, None] * (series",
        "return 1.0 * (series",
        "tests/free_energy/test_averages.py::test_weights_that_belong_to_the_values",
    ),
    (
        "free_energy/profiles/gaussian_process.py",
        "bend * first**2 + slope * second",
        "bend * first**2 - slope * second",
        "tests/free_energy/profiles/test_gaussian_process.py::test_covariances_of_gradients_are_derivatives_of_those_of_the_free_energy",
    ),
    (
        "free_energy/profiles/gaussian_process.py",
        "square = (2 * radius * np.sin(away / (2 * radius))) ** 2",
        "square = away**2",
        "tests/free_energy/profiles/test_gaussian_process.py::test_a_period_further_nothing_is_different",
    ),
    (
        "free_energy/profiles/gaussian_process.py",
        "axes=1) + (away.T * self.weights) @ away)",
        "axes=1))",
        "tests/free_energy/profiles/test_gaussian_process.py::test_an_average_over_processes_has_the_moments_of_a_mixture",
    ),
    (
        "free_energy/profiles/profile.py",
        "F=self.F + shift[:-1] - shift[-1]",
        "F=self.F - shift[:-1] + shift[-1]",
        "tests/free_energy/profiles/test_profile.py::test_jacobians",
    ),
    (
        "free_energy/profiles/profile.py",
        "rule = rule @ (np.eye(len(gain)) - np.outer(gain, whole))",
        "pass",
        "tests/free_energy/profiles/test_profile.py::test_a_period_closes",
    ),
    (
        "free_energy/profiles/mean_force_surface.py",
        "consistency.p_value < _CHANCE",
        "consistency.p_value < 0.0",
        "tests/free_energy/profiles/test_mean_force_surface.py::test_vectors_that_are_no_gradient_are_warned_of",
    ),
    (
        "free_energy/profiles/pulls.py",
        "(1 / effective - 1 / len(works))",
        "(1 / effective)",
        "tests/free_energy/profiles/test_pulls.py::test_bias_of_the_exponential_average",
    ),
    (
        "free_energy/profiles/pulls.py",
        "_one_way(back, drawn_back, -kT)",
        "_one_way(back, drawn_back, kT)",
        "tests/free_energy/profiles/test_pulls.py::test_directions_are_alike",
    ),
    (
        "free_energy/profiles/pulls.py",
        "other**2 / w + np.log(v / w)",
        "other**2 / w",
        "tests/free_energy/profiles/test_pulls.py::test_distributions_of_different_width_cross_between_their_means",
    ),
    (
        "constraints/constraint_set.py",
        "if any(getattr(item, name) != getattr(wanted, name) for name in wanted.shared):",
        "if any(name is None for name in wanted.shared):",
        "tests/free_energy/test_held_coordinates.py::test_formulas_on_the_same_atoms_are_told_apart",
    ),
]
