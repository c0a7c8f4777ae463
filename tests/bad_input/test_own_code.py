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
from lcc_rl.errors import ConfigError
from lcc_rl.pieces import Controller
from lcc_rl.runs.states import described_error


class Own(Controller):
    reads = ("self.speed",)

    def command(self, speed):
        return 0.0 * speed


class AtFirst(Own):
    def command(self, speed):
        return {}["gain"]  # of AtFirst


class AtSetup(Own):
    def setup(self, world) -> None:
        super().setup(world)
        self.most = world.profiles.speeds.max()  # of AtSetup


class Branching(Own):
    def command(self, speed):
        return speed if speed > 1.0 else -speed  # of Branching


class Late(Own):
    def command(self, speed):
        if bool((speed < 8.0).any()):
            raise RuntimeError("no more fuel")  # of Late
        return 0.0 * speed - 3.0


class Map(EnergyModel):
    mass = 1500.0

    def power(self, speed, acceleration):
        return {}["map"]  # of Map


class Total(Map):
    def power(self, speed, acceleration):
        return (150.0 * speed + 1500.0 * acceleration * speed).sum()


class Holed(Map):
    def power(self, speed, acceleration):
        power = 150.0 * speed + 1500.0 * acceleration * speed
        return torch.where(speed > 14.0, torch.nan, power)


def place(name: str) -> str:
    lines = enumerate(linecache.getlines(__file__), 1)
    number = next(number for number, text in lines if text.endswith(f"# of {name}\n"))
    return rf"\({re.escape(str(Path(__file__)))}:{number}\)"


def drive(controller=None, energy=None) -> None:
    settings = [f"energy._target_={__name__}.{energy}"] if energy else []
    lcc_rl.simulate([15.0] * 51, "automated", controller, overrides=settings)


def test_errors_at_set_up_and_in_the_first_step_name_type_and_line() -> None:
    cases = [
        (AtFirst(), None, f"^AtFirst fails: KeyError: 'gain' {place('AtFirst')}$"),
        (AtSetup(), None, f"^AtSetup fails: AttributeError: .*'speeds' {place('AtSetup')}$"),
        (Branching(), None, rf"RuntimeError: Boolean .* {place('Branching')} \(use torch.where"),
        (Own(), "Map", f"^Map.power: KeyError: 'map' {place('Map')}$"),
        (Own(), "Total", r"^Total.power: its shape is \[\] for speeds of shape \[2\]"),
        (Own(), "Holed", r"vehicles.power of MotorPower \(Holed\) is nan at step 1 of"),
    ]
    check_refused(drive, cases)


def test_an_error_in_a_later_step_is_one_line_of_a_command(capsys) -> None:
    words = f"RuntimeError: no more fuel {place('Late')}"
    with pytest.raises(SystemExit, match="2"):
        main_guard(drive)(Late())
    assert re.fullmatch(f"lcc_rl: error: {words}\n", capsys.readouterr().err)
    with pytest.raises(RuntimeError) as caught:
        drive(Late())
    assert re.fullmatch(words, described_error(caught.value))


def test_an_error_of_the_package_keeps_its_traceback() -> None:
    with pytest.raises(ZeroDivisionError):
        main_guard(eval)("1 / 0")
    with pytest.raises(ConfigError):
        Own(gain=1.0)
