"""Own controllers in a comparison: by name, class, function, file and object, on every task."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
import torch
import yaml
from commands import NO_AGENT, UNTRAINED, run_command
from helpers import POPULATION, check_refused, compose, wavy_profiles

import lcc_rl
from lcc_rl.commands import evaluation
from lcc_rl.config import load
from lcc_rl.config.nodes import Node, as_plain
from lcc_rl.config.schemas import AUTO
from lcc_rl.envs import build_env
from lcc_rl.errors import ConfigError, LccError
from lcc_rl.evaluation.named import controller_of, label_of, setting_of
from lcc_rl.evaluation.strategies import baseline
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.files import read_parquet
from lcc_rl.pieces import ConstantAcceleration, Controller, Law
from lcc_rl.results.policies import load_policy
from lcc_rl.settings import TARGET, Positive, Settings


class Steady(Controller):
    """A cruise control with a constant time gap."""

    gain: Positive = 0.2  # [1/s²]

    reads = ("self.gap", "self.speed", "ahead.speed")

    def command(self, gap, speed, ahead_speed):
        return steady(gap, speed, ahead_speed, self.gain)


def steady(gap, speed, ahead_speed, gain=0.2):
    return (gain * (gap - 2.0 - 1.3 * speed) + 0.8 * (ahead_speed - speed)).clamp(-3.0, 3.0)


pytestmark = pytest.mark.usefixtures("blank_figures")
PATH = f"{__name__}.Steady"
SMALL = [*NO_AGENT, "evaluation.drivers=2"]
ENERGY = "total_path_energy_kj"


def energies(rows) -> dict[str, float]:
    return rows.groupby("strategy", sort=False)[ENERGY].mean().to_dict()


def test_a_class_a_function_an_object_a_node_and_a_file_drive_alike(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(f"_target_: {PATH}\ngain: 0.2\n")
    every = {"class": Steady, "path": PATH, "function": steady, "object": Steady(gain=0.2)}
    every |= {"node": {TARGET: PATH}, "file": "mine.yaml", "slow": Steady(gain=0.1)}
    found = energies(lcc_rl.compare(every, overrides=SMALL, folder=tmp_path / "a").rows)
    assert list(found) == [*UNTRAINED, *every]
    assert len({found[name] for name in every}) == 2  # and the slow one, which is another
    assert found["slow"] != found["class"]


def test_an_own_controller_never_has_the_name_of_a_shipped_one() -> None:
    for who, label in (
        ("mine/my_idm_1.1.yaml", "my_idm_1.1"),
        ("idm_acc.yaml", "idm_acc.yaml"),  # not the tuned IDM, which idm_acc means
        ("alcc.onnx", "alcc.onnx"),
        ("follow.onnx", "follow"),
        ("mine/follow.onnx_filtered", "follow_filtered"),
        ("lcc_rl.pieces.IDM", "IDM"),
        ({TARGET: PATH, "gain": 0.3}, "Steady"),
        ({TARGET: "lcc_rl.pieces.Law", "law": f"{__name__}.steady"}, "steady"),
        ("idm_acc", "idm_acc"),
    ):
        assert label_of(setting_of(who)) == label


def test_a_name_that_ends_in_filtered_drives_behind_the_filter(tmp_path) -> None:
    full = ConstantAcceleration(acceleration=3.0)
    both = {"full": full, "full_filtered": full}
    words = [*SMALL, "+filter=cbf"]
    named = {"mine": "constant_filtered"}  # full throttle
    run = lcc_rl.compare(both | named, overrides=words, folder=tmp_path / "a")
    assert "filter: those called filtered, mine; all" in run.reports()[0].caption
    found = energies(rows := run.rows)
    assert found["full"] != found["full_filtered"] == found["mine"]
    acts = rows.groupby("strategy")["share_filter_acts"].mean()  # nobody obeys full throttle
    assert (acts[["full_filtered", "mine"]] > 0.5).all()
    assert acts.drop(["full_filtered", "mine"]).isna().all()
    with pytest.raises(LccError, match=r"\+filter=cbf adds one"):
        lcc_rl.compare(both, overrides=SMALL, folder=tmp_path / "b")


def test_constants_tuned_behind_a_filter_need_its_longest_gap(subtests) -> None:
    for longest, own in [("2.45", True), ("null", False)]:
        with subtests.test(longest=longest):
            words = ["variant=alcc", "+filter=cbf"]
            cfg = load("evaluate", [*words, f"scenario.filters.automated.time_gap={longest}"])
            names = ("idm_acc", "idm_acc_filtered", "constant_filtered")
            plain, behind, alone = (
                baseline(cfg, name).cfg.scenario.controllers["automated"] for name in names
            )
            assert (behind.made().desired_speed < plain.made().desired_speed) == own
            asked = baseline(cfg, "idm_acc_filtered", "idm_acc_filtered")  # compare=
            assert asked.cfg.scenario.controllers["automated"] == behind
            assert alone.made().acceleration == 3.0  # full throttle


@pytest.mark.parametrize(
    "words",
    [
        ["task=ring-22", f"compare=[{PATH}]", "evaluation.profiles=1"],
        pytest.param(["variant=cacc", f"compare=[{PATH}]"], marks=pytest.mark.slow),
        # Whom a task would let learn gives way to a controller that takes no action.
        pytest.param(
            ["task=i24-follow5", f"{AUTO}={{_target_: {PATH}}}", "compare=[idm_acc]"],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_an_own_controller_has_its_row_on_every_variant_and_task(words, tmp_path) -> None:
    size = ["experiment=smoke", "scenario.horizon=20"]
    rows = evaluation.run(load("evaluate", [*size, *words]), tmp_path, quiet=True)
    assert "Steady" in set(rows["strategy"])


@pytest.mark.slow
def test_a_variant_and_a_controller_of_a_folder_stand_in_the_table(tmp_path) -> None:
    node = f"{{_target_: {PATH}, gain: 0.3}}"
    place = "override /controller@scenario.controllers.automated: null"
    variant = f"""# @package _global_
defaults: [idm, {place}]
variant: own_variant
scenario: {{controllers: {{automated: {node}}}}}
"""
    for group, text in {"controller": node, "variant": variant}.items():
        (tmp_path / "conf" / group).mkdir(parents=True)
        (tmp_path / "conf" / group / f"own_{group}.yaml").write_text(text)
    words = ["--config-dir", "conf", *SMALL, "hydra.run.dir=run"]
    for typed in ("compare=[own_controller,own_variant]", "variant=own_variant"):
        run_command("evaluate", *words, typed, cwd=tmp_path, check=True)
        found = read_parquet(tmp_path / "run" / "episodes.parquet")
        assert "own_variant" in set(found["strategy"])
        (tmp_path / "run" / "episodes.parquet").unlink()
        (tmp_path / "run" / "config.yaml").unlink()


def test_who_cannot_drive_is_told_how(tmp_path) -> None:
    (tmp_path / "on.yaml").write_text("{_target_: lcc_rl.pieces.IDMACC, on: 3}")
    cases = [
        ("nowhere.X", "export PYTHONPATH"),
        (f"{__name__}.Nobody", "Nobody"),
        ("idm_ac", "'idm_ac'.*'idm_acc'.*--config-dir"),
        ("rule", "learned: .* lcc-rl train variant=rule"),
        ("nowhere.yaml", "nowhere.yaml: no such file"),
        (str(tmp_path / "on.yaml"), r"on\.yaml: the key True is no name: quote it"),
        ("my_pid.py", r"my_pid.py is a module: name a class or function in it, my_pid.<Class>"),
        ({"gain": 3}, "expected _target_"),
        ({TARGET: PATH, "gian": 3}, "'gian'.*'gain'"),
        ({TARGET: "lcc_rl.pieces.TimeGap"}, r"expected a subclass of .*\.Controller"),
    ]
    check_refused(controller_of, cases)


class Winding(Steady):
    """Its command is a number, its memory is not."""

    remembers = ("wound",)

    def command(self, gap, speed, ahead_speed, wound):
        wanted = super().command(gap, speed, ahead_speed)
        return wanted + wound.nan_to_num(), wound + torch.inf


def test_a_memory_that_is_no_number_ends_an_evaluation(tmp_path) -> None:
    with pytest.raises(LccError, match=r"Winding: automated\.wound of Winding is inf at step 1 of"):
        lcc_rl.compare([Winding], overrides=SMALL, folder=tmp_path)


def test_a_file_that_the_package_hides_is_refused(tmp_path) -> None:
    path = tmp_path / "mine" / "controller" / "acc.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(f"_target_: {PATH}\n")
    words = ["--config-dir", str(tmp_path / "mine"), "experiment=smoke", "compare=[acc]"]
    done = run_command("evaluate", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert f"{path}: the package has a file of this name" in done.stderr


def test_what_cannot_be_named_or_told_apart_is_refused(tmp_path) -> None:
    names = ("rule", "alcc", "idm_acc", "acc_filtered")
    cases = [
        ([lambda gap: gap], "at the top level of a module"),
        ([partial(steady, gain=0.1)], "at the top level of a module"),
        *(({x: PATH}, f"names Steady {x}, which stands for '.+': choose") for x in names),
        ([PATH, PATH], "two Steady: give each a name"),
    ]
    check_refused(lambda who: lcc_rl.compare(who, overrides=SMALL, folder=tmp_path), cases)


def unknown(gap, velocity):
    return gap - velocity


def plain_number(gap):
    return 0.5


class Wide(Steady):
    def command(self, *entries):
        return super().command(*entries).expand(-1, -1, 2)


class Forgetful(Steady):
    remembers = ("integral",)

    def command(self, gap, speed, ahead_speed, integral):
        return super().command(gap, speed, ahead_speed)


class Talkative(Steady):
    def command(self, *entries):
        return super().command(*entries), entries[0]


class Unwritten(Steady):
    reads = ("self.gap", "self.speed", "my.last")


def test_a_controller_that_does_not_fit_is_named_and_leaves_no_folder(tmp_path) -> None:
    cases = [
        (unknown, r"\.unknown reads vehicles.velocity, .* only .*vehicles.gap, .*vehicles.speed"),
        (plain_number, r"\.plain_number .* returned 0.5, not a tensor; it must return automated"),
        (Wide, r"Wide writes automated.command as \[1, 2\]"),
        (Forgetful, r"returned 1 instead of 2 .* automated.command and automated.integral as"),
        (Talkative, r"returned 2 instead of 1 .* must return automated.command as tensors"),
        (Unwritten, r"Unwritten reads my.last, which no piece of the scenario writes;"),
    ]
    out = {"overrides": SMALL, "folder": tmp_path / "a"}
    check_refused(lambda who: lcc_rl.compare([who], **out), cases)
    typed = [*SMALL, f"compare=[{__name__}.Wide]", "hydra.run.dir=b"]
    assert run_command("evaluate", *typed, cwd=tmp_path).returncode == 2
    assert not list(tmp_path.iterdir())


def test_names_of_rows_on_the_command_line(tmp_path) -> None:
    named = {"IDM T_1.8 s": "idm", "a-b+c/d%e*f@g?h|i": "acc"}
    text = ", ".join(f"{name}: {who}" for name, who in named.items())
    assert load("evaluate", [*SMALL, f"compare={{{text}}}"]).compare == named
    assert load("evaluate", [*SMALL, "compare={1: idm}"]).compare == {"1": "idm"}
    typed = f'compare={{"IDM, T = 1.8 s": {PATH}}}'
    with pytest.raises(LccError, match=re.escape(typed) + ".*: names before a colon|no quotes"):
        load("evaluate", [*SMALL, typed])
    rows = lcc_rl.compare({"IDM, T = 1.8 s": Steady}, overrides=SMALL, folder=tmp_path / "a").rows
    assert "IDM, T = 1.8 s" in set(rows["strategy"])


class Counting(Controller):
    """Accelerates by the number of steps driven."""

    reads = ("self.speed",)
    remembers = ("steps", "first_speed")

    def command(self, speed, steps, first):
        first = torch.where(steps == 0, speed, first)
        return 0.01 * steps + 0.0 * speed, steps + 1.0, first


def test_what_a_controller_remembers_is_its_roles_entry_from_zero_on() -> None:
    node = f"{{_target_: {__name__}.Counting}}"
    roles = [f"scenario.controllers.{role}={node}" for role in (AUTOMATED, "human")]
    start = "scenario.start.human=${scenario.start.automated}"
    env = build_env(compose("idm", *roles, start), wavy_profiles(), POPULATION, 2)
    data = env.rollout(4)
    for role in (AUTOMATED, "human"):
        found = data["next", role, "steps"][..., 0, 0]
        assert torch.equal(found, torch.arange(1.0, 5.0).expand(2, 4))
        assert torch.equal(data["next", role, "command"][..., 0, 0], 0.01 * (found - 1.0))
        first = data["vehicles", "speed"][:, :1, int(role == "human"), 0]
        assert (data["next", role, "first_speed"][..., 0, 0] == first).all()


class Band(Settings):
    high: Positive = 1.3


@dataclass(frozen=True)
class Lead:
    time: float = 1.4


class Shaped(Controller):
    """Has settings of every kind."""

    gains: tuple[float, float] = (0.2, 0.8)
    band: Band = Band()
    lead: Lead = Lead()
    table: dict[str, float] = None  # no default that its annotation allows
    place: Path | None = None

    reads = ("self.gap", "self.speed", "self.relative_speed")

    def command(self, gap, speed, relative_speed):
        wanted = gap - self.lead.time * self.band.high * speed
        return self.gains[0] * wanted + self.gains[1] * relative_speed


def test_settings_of_own_controllers_are_of_any_kind_that_files_can_hold() -> None:
    path = f"{__name__}.Shaped"
    given = {TARGET: path, "gains": [0.3, 0.8], "band": {"high": 1.5}, "lead": {"time": 1.0}}
    own = Shaped(gains=(0.3, 0.8), band=Band(high=1.5), lead=Lead(1.0))
    for who, shape in (
        (Shaped, (0.2, 1.3, 1.4)),
        (path, (0.2, 1.3, 1.4)),
        (Shaped(), (0.2, 1.3, 1.4)),
        (given, (0.3, 1.5, 1.0)),
        (own, (0.3, 1.5, 1.0)),
    ):
        node = controller_of(setting_of(who))
        found = controller_of(Node.of(yaml.safe_load(yaml.safe_dump(as_plain(node))), "x")).made()
        assert (found.gains[0], found.band.high, found.lead.time) == shape, who
    with pytest.raises(ConfigError, match=r"^compare\.mine\.place is .* cannot store"):
        setting_of(Shaped(place=Path("x")), "compare.mine")
    with pytest.raises(ConfigError, match=r"^compare\.mine\.band\.high must be greater than 0"):
        setting_of({**given, "band": {"high": -1.0}}, "compare.mine")
    with pytest.raises(ConfigError, match=r"^compare\.mine\.gains\[1\] must be a valid number"):
        setting_of({**given, "gains": [0.3, "a"]}, "compare.mine")


class Hard(Controller):
    """Brakes harder than an automated vehicle may."""

    reads = ("self.speed",)

    def command(self, speed):
        return torch.full_like(speed, -5.0)


class Harder(Hard):
    max_acceleration: Positive = 4.0  # [m/s²]


def test_commands_to_automated_vehicles_alone_are_bounded() -> None:
    hard, harder = ({TARGET: f"{__name__}.{name}"} for name in ("Hard", "Harder"))
    handover = {TARGET: "lcc_rl.pieces.Handover", "before": harder, "after": hard, "from_s": 0.2}
    same_start = "scenario.start.human=${scenario.start.automated}"
    strong = (same_start, "scenario.max_braking=4.5")
    cases = (
        ((same_start,), hard, -3.0),
        (strong, hard, -4.5),
        (strong, harder, -4.0),
        (strong, handover, (-4.0, -4.0, -4.5)),
    )
    for words, node, least in cases:
        cfg = compose("idm", *words)
        drivers = {AUTOMATED: node, "human": hard}
        nodes = {role: Node.of(own, role) for role, own in drivers.items()}
        cfg = cfg.with_(scenario={"controllers": nodes})
        command = build_env(cfg, wavy_profiles(), POPULATION, 2).rollout(3)["next"]
        expected = torch.tensor(least).expand(2, 3)
        assert torch.equal(command[AUTOMATED, "command"][..., 0, 0], expected), node
        assert (command["human", "command"] == -5.0).all()


def test_a_law_reads_what_its_parameters_name() -> None:
    law = Law(law=f"{__name__}.steady").bind(name=AUTOMATED)
    assert law.names == ("self.gap", "self.speed", "ahead.speed")
    entries = [torch.full((3, 1, 1), value) for value in (20.0, 10.0, 12.0)]
    assert torch.equal(law.command(*entries), steady(*entries))


def test_a_training_that_has_not_ended_says_how_it_goes_on(tmp_path) -> None:
    (tmp_path / "checkpoint.pt").touch()
    with pytest.raises(LccError, match=f"{tmp_path}: its training has not ended: .* resume="):
        lcc_rl.compare([tmp_path], overrides=SMALL, folder=tmp_path / "a")


def test_what_is_no_policy_file_is_named_with_its_remedy(tmp_path) -> None:
    (tmp_path / "sweep" / "one").mkdir(parents=True)
    (tmp_path / "sweep" / "one" / "config.yaml").touch()
    with pytest.raises(LccError, match=r"not a run folder: .* it holds the run one"):
        load_policy(tmp_path / "sweep")
    (tmp_path / "x.onnx").touch()
    with pytest.raises(LccError, match=r"x\.onnx is an ONNX program.*compare=\["):
        load_policy(tmp_path / "x.onnx")
    with pytest.raises(LccError, match=r"expected a list of settings, .* got 'seed=1'"):
        load("train", "seed=1")
