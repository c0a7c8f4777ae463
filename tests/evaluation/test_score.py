"""``lcc-rl score``: rows of whoever drives, comparable by their hashes."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import pytest
from commands import content
from helpers import check_refused, slow_but
from page_blocks import ROOT

import lcc_rl
from lcc_rl.cli.score import main
from lcc_rl.commands.score import about, play_source, scored
from lcc_rl.config import load
from lcc_rl.envs import build_env
from lcc_rl.envs.inputs import build_drivers, constant_profiles
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.pieces.knowledge import foreseen
from lcc_rl.results import board
from lcc_rl.runs.states import Busy, claim

SMALL = ("scenario.horizon=60", "evaluation.warm_up=0", "evaluation.profiles=3")
ON = ("--task", "i80-follow", "--on", "everyday", "evaluation.drivers=2", *SMALL)


def scores(folder: Path, who: str, *words: str) -> dict:
    assert main([who, "--out", str(folder), *words]) == 0
    return json.loads((folder / "score.json").read_text())


def numbers(document: dict) -> list[tuple]:
    """Return everything but names and hashes of a document's rows."""
    return [
        tuple(value for value in row.values() if isinstance(value, float))
        for row in document["results"]
    ]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_an_exported_policy_scores_as_the_policy_itself(tmp_path, capsys) -> None:
    for name in ("onnxscript", "onnxruntime"):
        pytest.importorskip(name, reason="extra interfaces")
    who = "pretrained/i80-follow"
    # A file's name is never that of a baseline, whatever it is.
    lcc_rl.export(who, tmp_path / "human.onnx")
    one = scores(tmp_path / "a", who, *ON)
    other = scores(tmp_path / "b", str(tmp_path / "human.onnx"), *ON)
    (row,), (same,) = numbers(one), numbers(other)
    assert same == pytest.approx(row, rel=1e-4, abs=1e-6)
    for key in ("data", "settings"):  # of what was played, not of who played
        assert one["results"][0][key] == other["results"][0][key]
    assert one["sha256"] != other["sha256"]
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


def test_a_controller_is_played_where_it_fits_and_the_rest_is_named(
    tmp_path, capsys, caplog
) -> None:
    caplog.set_level("INFO")
    tasks = ("--task", "i80-follow", "--task", "platoon-highway")
    source = ("--source", "mine", "leader=everyday", "leader.evaluation_share=0.6")
    found = scores(tmp_path / "a", "deadbeat", *tasks, "--on", "everyday", *SMALL, *source)
    places = [(row["task"], row["source"]) for row in found["results"]]
    assert places == [("platoon-highway", "everyday"), ("platoon-highway", "mine")]
    one, other = found["results"]
    assert (one["data"], one["settings"]) != (other["data"], other["settings"])
    assert "left out: i80-follow: " in capsys.readouterr().out
    assert "platoon-highway, mine" in caplog.messages


def test_the_hash_is_of_the_code_of_an_own_controller(tmp_path, monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    code = "def law(gap, speed): return 0.2 * (gap - 2.0 - {} * speed)\n"
    (tmp_path / "law.yaml").write_text("{_target_: lcc_rl.pieces.Law, law: own_law.law}\n")
    hashes = []
    for seconds in (1.3, 1.4):
        (tmp_path / "own_law.py").write_text(code.format(seconds))
        monkeypatch.delitem(sys.modules, "own_law", raising=False)
        hashes += [about(scored(who))["sha256"] for who in ("own_law.law", "law.yaml")]
    assert len({*hashes}) == 4
    assert hashes[2] == hashlib.sha256((tmp_path / "own_law.py").read_bytes()).hexdigest()
    assert about(scored("idm_acc"))["sha256"] is None


def test_mistakes_are_named(tmp_path) -> None:
    cases = [
        ("idm_ac", "'idm_acc'"),
        ("direct", "direct cannot be scored"),
        ("idm --task i80", "nothing could be played: i80: .*i80-follow"),
        ("idm --task i80-follow --on moon", "no such source, only stream, "),
        ("idm --task i80-follow --on moon --on everyday", "--on moon: no such source, only stream"),
        ("idm --task i80-follow +filter=cbf", "has no effect: nothing drives behind the filter"),
        ("idm --source ../x leader=i24", "expected a new name"),
        ("idm --source x agent=ddpg", "expected settings of data, "),
        ("idm data=stream", "each task has its own"),
        ("idm --name idm_acc", "--name idm_acc stands for .tuned IDM. in"),
        ("acc_filtered --task i80-follow", "the task has no safety filter: score acc without one"),
    ]
    to = ("--out", str(tmp_path / "a"))
    check_refused(lambda words: main([*words.split(), *to]), cases, ConfigError)
    assert not list(tmp_path.iterdir())


LIMITS = {"share_ttc_unsafe": {"bound": 0.01, "value": 0.005}}
ROW = {"task": "t", "source": "s", "data": "1", "settings": "2", "kept": True, "collisions": 0}
ROW |= {"saving": 0.02, "saving_low": 0.01, "saving_high": 0.03, "limits": LIMITS}
ROW |= {"score": 98.0, "baseline": 100.0, "measure": "path_energy", "unit": "kJ/km"}
ROW |= {"against": "human", "distance_lost": 0.0, "flow_vph": None, "flow_lost": None}
ROW |= {"windows": 20, "drives": 1, "string_ratio": None, "future": []}
BROKEN = {"share_ttc_unsafe": {"bound": 0.01, "value": 0.02}}
HEADINGS = [({"unit": "g/km"}, "unit"), ({"measure": "net_energy"}, "measure")]
HEADINGS += [({"against": "idm"}, "against")]
WIDER = {"share_ttc_unsafe": {"bound": 0.5, "value": 0.02}}


def test_a_table_of_scores_refuses_what_is_not_alike_or_contradicts_itself() -> None:
    row, other = r"b\.json, row 1", "t behind other was measured with other"
    cases = [
        ({"data": "3"}, r"b\.json: t behind s .* other data"),
        ({"saving": 0.5}, rf"{row}: t behind s: the saving 0\.5 is not within .* 0\.01 … 0\.03"),
        ({"limits": BROKEN}, rf"{row}: t behind s: kept is True, but .* not kept: TTC < 4 s"),
        ({"kept": False}, r"kept is False, but limits are not kept: none"),
        ({"collisions": 3}, r"kept is True, but .* 3 coll\."),
        ({"limits": WIDER}, r"b\.json: t: it has other limits"),
        ({"saving": 0.025}, r"b\.json.* the saving 0\.025 is not that of 98\.0 against 100\.0"),
        *(({"source": "other", **one}, f"{other} {key}") for one, key in HEADINGS),
        ({"score": 49.0, "baseline": 50.0}, "measured with other baseline"),
        ({"flow_vph": float("nan")}, r"b\.json, row 1.flow_vph must be .*, got nan"),
        ({"string_ratio": "x"}, r"b\.json, row 1.string_ratio must be .*, got 'x'"),
        ({"saving_high": None}, "the saving .* is not within its interval .* None"),
        ({"baseline": None}, "the saving .* is not that of .* against None"),
        ({"score": None}, "the saving .* is not that of None against"),
        ({"collisions": "no"}, r"b\.json, row 1.collisions must be .*, got 'no'"),
        ({"collisions": -3}, r"b\.json, row 1.collisions must be .*, got -3"),
        ({"source": "s\nt"}, r"b\.json, row 1.source must"),
        ({"saving": "2 %"}, r"row 1.saving must be .*, got '2 %'"),
        ({"limits": {"share_ttc_unsafe": {"bound": 0.01}}}, r"row 1.limits.share_ttc.*value"),
        ({"limits": {"speed": {"bound": 0.01, "value": 0.0}}}, "unknown limit .* 'speed'"),
        ({"limits": []}, r"row 1.limits must"),
        ({"kept": None}, r"row 1.kept must be .*, got None"),
        ({}, r"a\.json and b\.json both score a"),
    ]

    def check(edited: dict[str, object]) -> None:
        other = {"name": "b" if edited else "a", "results": [{**ROW, **edited}]}
        board.check_alike({"a.json": {"name": "a", "results": [ROW]}, "b.json": other})

    check_refused(check, cases, ConfigError)
    whole = [
        (["a"], "expected an object with a name"),
        ({"name": "a"}, "b.json: expected an object"),
        ({"name": "a\nb", "results": [ROW]}, "a name, in one line, and results"),
        ({"name": "a", "results": [3]}, "b.json, row 1: expected a row with names, got 3"),
        ({"name": "a", "results": [{"task": "t"}]}, "b.json, row 1: it lacks source, measure,"),
    ]
    check_refused(lambda document: board.check_alike({"b.json": document}), whole, ConfigError)
    rounded = {"name": "b", "results": [{**ROW, "baseline": 100.001}]}  # of another processor
    board.check_alike({"a.json": {"name": "a", "results": [ROW]}, "b.json": rounded})


UNSAVED = dict.fromkeys(("saving", "saving_low", "saving_high", "distance_lost"))
UNSAVED |= {"kept": False, "collisions": 1}


@pytest.mark.parametrize("some", [UNSAVED, {**UNSAVED, "score": None, "collisions": 20}])
def test_rows_with_collisions_have_dashes_and_their_number(some: dict[str, object]) -> None:
    row = {**ROW, **some}
    table = board.score_table("mine", [row])
    cells = {column.header: list(column.cells)[-1] for column in table.columns}
    assert cells["dis-\ntance\n[%]"] == cells["saved [%]\nagainst"] == "–"
    assert cells["score"] == ("98.00" if row["score"] else "–")
    assert cells["limits\nkept"] == f"{row['collisions']} coll."
    page = board.leaderboard({"a.json": {"name": "a", "results": [row]}})
    assert f"| – | – | – | {row['collisions']} coll. |" in page


def test_what_a_controller_reads_of_the_future_is_named(tmp_path, monkeypatch) -> None:
    knowing = scored("deadbeat oracle").strategy(load("evaluate", ["task=platoon-us06"]))[1]
    assert knowing == ["leader.next_speed"]
    cfg = load("train", ["variant=alcc", "+knowledge=preview"])
    env = build_env(cfg, constant_profiles(10.0, 600, 0.1, ["a"]), build_drivers(cfg), 1)
    assert foreseen(pieces_of(env)) == ["preview.speed"]
    row = {**ROW, "future": knowing}
    table = board.score_table("mine", [row])
    assert list(table.columns[0].cells)[-1] == "  s §"
    page = board.leaderboard({"a.json": {"name": "a", "results": [row]}})
    for text in (str(table.caption), page):
        assert "§: reads the leader's future (leader.next_speed)." in text
    assert "| `a` § |" in page
    code = """from lcc_rl.pieces import Controller
class Seer(Controller):
    reads = ("self.speed",)
    def setup(self, world):
        super().setup(world)
        assert world.profiles is None
    def command(self, speed):
        return -speed
"""
    (tmp_path / "foreign_seer.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert scored("foreign_seer.Seer").strategy(load("evaluate", ["task=i80-follow"]))[1] == []


def test_limits_of_comfort_and_of_standing_belong_to_the_tasks_that_they_decide() -> None:
    for task in ("i24-follow5", "i24-mixed", "i24-fleet"):
        assert load("evaluate", [f"task={task}"]).task["limits"]["rms_jerk_mps3"] == 2.0
    dithered = {"rms_jerk_mps3": {"bound": 2.0, "value": 5.57}}  # fuel cut in every other step
    crept = {"mean_speed_mps": {"bound": 4.8, "value": 0.99}}
    assert load("evaluate", ["task=i80-follow"]).task["limits"]["mean_speed_mps"] == "95 %"
    for limits, word in ((dithered, "RMS jerk"), (crept, "mean speed")):
        assert board.broken({**ROW, "limits": limits}) == [word]


def test_a_killed_score_is_played_again_and_a_finished_or_running_one_is_left_alone(
    tmp_path,
) -> None:
    folder = tmp_path / "a"
    (folder / "i80-follow" / "everyday").mkdir(parents=True)
    with claim(folder), pytest.raises(Busy):
        scores(folder, "idm_acc", *ON)
    scores(folder, "idm_acc", *ON)
    before = content(folder)
    with pytest.raises(ResultsError, match=r"already holds .* choose another --out"):
        scores(folder, "acc", *ON)
    assert content(folder) == before


def test_a_limit_that_is_a_share_of_the_baseline_counts(tmp_path) -> None:
    words = ["task=i80-follow", "leader=everyday", "evaluation.drivers=2", *SMALL]
    cfg = load("evaluate", [*words, "task.limits.flow_vph='200 %'"])
    row = play_source(scored("idm_acc"), "everyday", cfg, tmp_path)
    flow = row["limits"]["flow_vph"]
    assert flow["bound"] > flow["value"] > 0.0
    assert not row["kept"]


def test_a_score_has_the_name_given_and_a_failed_one_says_why_in_its_folder(tmp_path) -> None:
    source = ("--source", "mine", "leader=i24", "leader.path=nowhere.parquet")
    words = ["idm_acc", "--name", "my IDM", *ON, *source]
    with pytest.raises(ConfigError, match="--source mine could not be played"):
        main([*words, "--out", str(tmp_path / "a")])
    assert json.loads((tmp_path / "a" / "score.json").read_text())["name"] == "my IDM"
    assert (tmp_path / "a" / "error.txt").read_text().startswith("--source mine could not be")


@pytest.mark.parametrize(
    ("task", "source"),
    slow_but([("i80-follow", "platoons")], [("ring-22", "ring"), ("i80-follow", "platoons")]),
)
def test_rows_of_the_leaderboard_come_out_again(task: str, source: str, tmp_path) -> None:
    found = scores(tmp_path / "a", f"pretrained/{task}", "--task", task, "--on", source)
    kept = json.loads((ROOT / "outputs" / "reference" / "scores" / f"{task}.json").read_text())
    assert found["sha256"] == kept["sha256"]
    same = [row for row in kept["results"] if (row["task"], row["source"]) == (task, source)]
    for key in ("data", "settings", "kept"):
        assert [row[key] for row in found["results"]] == [row[key] for row in same]
    (row,), (before,) = numbers(found), numbers({"results": same})
    assert row == pytest.approx(before, rel=1e-3, abs=1e-4)
