"""The list of faults holds where code and tests move."""

from __future__ import annotations

import mutants as tool


def test_every_fault_can_be_made_and_has_tests() -> None:
    for mutant in tool.mutants().values():
        compile(mutant.applied((tool.ROOT / mutant.file).read_text()), mutant.file, "exec")
        assert mutant.tests
        assert all((tool.ROOT / name).exists() for name in mutant.tests), mutant.name


def test_the_first_failure_is_found_in_what_pytest_says() -> None:
    said = "F\n=== short test summary info ===\nFAILED tests/a.py::test_b[x - y] - assert 1 == 2\n"
    assert tool.FAILED.search(said)[1] == "tests/a.py::test_b[x - y]"
