"""The running code against the recorded outcomes: as exact where solved to the end, as certified elsewhere, as strict."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from golden.groups import GROUPS
from golden.judge import differences
from golden.record import FOLDER, Outcome, load

ACCEPTED: dict[str, str] = {}
"""Cases that may differ from their record, "group: case" -> why. One that no longer differs fails until it is taken out."""

CASES = {f"{group}: {name}": (group, case) for group, cases in GROUPS.items() for name, case in cases().items()}


@cache
def recorded(group: str) -> dict[str, list[Outcome]]:
    return load(FOLDER / f"{group}.npz")


@pytest.mark.parametrize("name", CASES)
def test_as_recorded(name: str) -> None:
    group, case = CASES[name]
    found = differences(case, case.run(), recorded(group)[case.name])
    if name in ACCEPTED:
        assert found, f"accepted ({ACCEPTED[name]}) but differs no longer: take it out of ACCEPTED"
    else:
        assert not found, "\n".join(found)


@pytest.mark.parametrize("group", GROUPS)
def test_every_record_has_its_case(group: str) -> None:
    assert list(recorded(group)) == list(GROUPS[group]())


def test_accepted_cases_exist_and_say_why() -> None:
    assert set(ACCEPTED) <= set(CASES)
    assert all(reason.strip() for reason in ACCEPTED.values())


def test_the_files_hold_no_pickles_and_stay_small() -> None:
    files = sorted(FOLDER.glob("*.npz"))
    assert sum(file.stat().st_size for file in files) <= 2_000_000
    for file in files:
        with np.load(file, allow_pickle=False) as columns:
            assert all(columns[name].dtype != object for name in columns.files)
