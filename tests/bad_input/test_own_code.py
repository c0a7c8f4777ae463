"""Errors in a user's controllers and energy models name their type, file and line."""

from __future__ import annotations

import linecache
import re
from pathlib import Path

import pytest
import torch
from helpers import check_refused

import lcc_rl
from lcc_rl.cli.guard import main_guard
from lcc_rl.energy import EnergyModel
from lcc_rl.errors import is_users
from lcc_rl.pieces import Controller


def at_first(speed):
    return {}["gain"]  # of at_first


def branching(speed):
    return speed if speed > 1.0 else -speed  # of branching


def late(speed):
    if bool((speed < 8.0).any()):
        raise RuntimeError("no more fuel")  # of late
    return 0.0 * speed - 3.0


class AtSetup(Controller):
    def setup(self, world) -> None:
        self.most = world.profiles.speeds.max()  # of AtSetup

    def command(self, speed):
        return speed


class Map(EnergyModel):
    mass = 1500.0

    def power(self, speed, acceleration):
        return {}["map"]  # of Map


class Total(Map):
    def power(self, speed, acceleration):
        return (150.0 * speed + 1500.0 * acceleration * speed).sum()


class Holed(Map):
    def power(self, speed, acceleration):
        return (150.0 + 1500.0 * acceleration) * speed * torch.where(speed > 14.0, torch.nan, 1.0)


def place(name: str) -> str:
    lines = linecache.getlines(__file__)
    number = next(n for n, text in enumerate(lines, 1) if text.endswith(f"# of {name}\n"))
    return rf"\({re.escape(__file__)}:{number}\)"


def drive(controller=None, energy=None) -> None:
    settings = [f"energy._target_={__name__}.{energy}"] if energy else []
    lcc_rl.simulate([15.0] * 51, "automated", controller, overrides=settings)


def test_errors_of_a_users_code_name_type_and_line(capsys) -> None:
    cases = [
        (at_first, None, f"at_first fails: KeyError: 'gain' {place('at_first')}$"),
        (AtSetup(), None, f"^AtSetup fails: AttributeError: .*'speeds' {place('AtSetup')}$"),
        (branching, None, rf"RuntimeError: Boolean .* {place('branching')} \(use torch.where"),
        ("idm", "Map", f"^Map.power: KeyError: 'map' {place('Map')}$"),
        ("idm", "Total", r"^Total.power: its shape is \[\] for speeds of shape \[2\]"),
        ("idm", "Holed", r"vehicles.power of MotorPower \(Holed\) is nan at step 1 of"),
    ]
    check_refused(drive, cases)
    with pytest.raises(SystemExit, match="2"):
        main_guard(drive)(late)
    said = capsys.readouterr().err
    assert re.fullmatch(f"lcc_rl: error: RuntimeError: no more fuel {place('late')}\n", said)
    with pytest.raises(ZeroDivisionError):  # no user's code: keeps its traceback
        main_guard(eval)("1 / 0")


def test_a_failed_allocation_names_the_settings_that_need_less(capsys) -> None:
    with pytest.raises(SystemExit, match="2"):
        main_guard(torch.zeros)(10**15)
    said = capsys.readouterr().err
    assert re.fullmatch("lcc_rl: error: too little memory: .*; lower training.env.*_size\n", said)


def test_code_of_tools_and_of_compilers_is_no_users(tmp_path) -> None:
    tool, stored = Path(__file__).parents[2] / "tools" / "size.py", tmp_path / "c4.py"
    assert not is_users("__main__", tool)
    assert not is_users("torch._inductor.runtime.compile_tasks.c4", stored)
    assert is_users("c4", stored)
