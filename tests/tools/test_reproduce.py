"""The command that reproduces a study: refused in one line, and the recipe of its runs."""

from __future__ import annotations

import pytest

from lcc_rl.commands import reproduce as tool
from lcc_rl.runs.cli import main_guard


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["alcc", "--recipe", "smok"], "smok"),
        (["alcc", "--parts", "mian"], "Did you mean 'main'?"),
        (["alcc", "data"], "expected overrides"),
        (["alcc", "seed=3"], "say --seeds"),
        (["report", "nowhere"], "no evaluation/episodes.parquet"),
        (["report", "nowhere", "--formats", "pdf,emf"], "'emf'; valid: pdf, png, svg"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, words, expected) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        main_guard(tool.main)(words)
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert expected in said
    assert len(said.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "recipe"),
    [
        ([], "paper_alcc"),
        (["agent=analytic"], None),
        (["agent.gamma=0.9"], "paper_alcc"),
        (["agent=td3", "--recipe", "quickstart"], "quickstart"),
    ],
)
def test_another_agent_comes_with_its_own_length(tmp_path, monkeypatch, words, recipe) -> None:
    class SeenError(Exception):
        pass

    def run(study, parts, command):
        raise SeenError(study.recipe, study.runs(study.folder)[0].compose().training.episodes)

    monkeypatch.setattr(tool.alcc, "run", run)
    with pytest.raises(SeenError) as seen:
        tool.main(["alcc", "--out", str(tmp_path), *words])
    lengths = {None: 30720, "paper_alcc": 3000, "quickstart": 1500}
    assert seen.value.args == (recipe, lengths[recipe])
