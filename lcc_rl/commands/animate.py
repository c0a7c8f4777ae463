"""Animate sample episodes of an evaluation: lcc-rl animate outputs/evaluate/<run>.

lcc-rl animate RUN                           # the last strategy, RUN/figures
lcc-rl animate RUN --strategy idm_acc --episode 1 --out idm.gif
lcc-rl animate RUN --start 60 --duration 30 --out wave.mp4   # needs ffmpeg
lcc-rl animate RUN --strategy human --strategy "alcc: a network" --out r.svg
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lcc_rl.errors import ConfigError, ResultsError, require
from lcc_rl.figures.animation import ANIMATION_FORMATS, animate, check_ending
from lcc_rl.figures.drawing import in_file
from lcc_rl.io.atomic import new_file
from lcc_rl.io.files import read_parquet
from lcc_rl.results.motion import SampleMotion, motion_of, sample_episodes
from lcc_rl.results.names import in_words, strategy_named
from lcc_rl.results.runs import CONFIG, STEPS, naming_run, read_settings
from lcc_rl.runs.arguments import Arguments, typed
from lcc_rl.runs.states import no_run
from lcc_rl.settings import NonNegative, Whole

SAMPLES_KEPT = "evaluation.sample_episodes=4"


def run(
    folder: str | Path,
    strategies: Sequence[str] = (),
    episode: int = 0,
    out: str | Path | None = None,
    start: float = 0.0,
    duration: float | None = None,
) -> Path:
    """Write an animation of a sample episode.

    Args:
        folder: folder of an evaluation, a training or a main job.
        strategies: names in the table or its rows, or ``"<name>: <title>"``; by default the last
            one of the table. An ``.svg``, or on an open road a ``.gif``, shows several side by
            side.
        episode: index of the sample episode.
        out: the file, see :func:`lcc_rl.figures.animation.animate`; by default a page in the
            run's folder ``figures``.
        start: start of the animation [s].
        duration: its duration [s]; None: to the end.

    Returns:
        The path of the file.

    Raises:
        ConfigError: if there is no such run, strategy, episode, ending or time.
        ResultsError: if no sample episode is stored, or the file cannot be written.
    """
    folder = with_steps(Path(folder))
    if out is not None:
        check_ending(new_file(out, "--out"), len(strategies))
    steps = read_parquet(folder / STEPS)
    require(not steps.empty, f"{folder}: holds no sample episode; evaluate with {SAMPLES_KEPT}")
    motions = {}
    with naming_run(folder):
        names = list(dict.fromkeys(map(str, steps["strategy"])))
        named = [name.partition(": ")[::2] for name in strategies or names[-1:]]
        for key, title in named:
            strategy = strategy_named(key, names)
            episodes = list(sample_episodes(steps, strategy).items())
            text = f"--episode must lie from 0 to {len(episodes) - 1}, got {episode}"
            require(0 <= episode < len(episodes), text)
            label, rows = episodes[episode]
            scenario = read_settings(folder / CONFIG)["scenario"]
            motion = _cut(motion_of(rows, scenario), start, duration)
            # Side by side, only a short title fits.
            name = in_words(strategy) + (f": {label}" if len(named) == 1 else "")
            require((title or name) not in motions, f"--strategy {key}: a second {title or name!r}")
            motions[title or name] = motion
    default = folder / "figures" / f"animation_{in_file(named[0][0])}_{episode}.html"
    return animate(motions, out or default)


def _cut(motion: SampleMotion, start: float, duration: float | None) -> SampleMotion:
    """Return the animated part of an episode."""
    end = float("inf") if duration is None else start + duration
    inside = ((motion.time >= start) & (motion.time <= end)).nonzero()[0]
    if len(inside) < 2:
        first, last = motion.time[0], motion.time[-1]
        raise ConfigError(
            f"--start {start:g} and --duration leave fewer than two samples: the episode lasts "
            f"from {first:g} to {last:g} s"
        )
    return motion.at(slice(inside[0], inside[-1] + 1))


def with_steps(folder: Path) -> Path:
    """Return the folder of a run's sample episodes; for a main job, of its evaluation."""
    for path in (folder, folder / "evaluation"):
        if (path / STEPS).is_file():
            return path
    if not (folder / CONFIG).is_file():
        raise no_run(folder)
    raise ResultsError(f"{folder}: holds no {STEPS}: not evaluated yet?")


def main(words: Sequence[str] | None = None) -> int:
    """Write the animation of a command line; print its path."""
    parser = Arguments(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of an evaluation, training or main job")
    words_of = "name, or 'name: title'; by default the last of the evaluation"
    parser.add_argument("--strategy", action="append", default=[], help=words_of)
    number = typed(NonNegative)
    parser.add_argument(
        "--episode", type=typed(Whole), default=0, help="index of the sample episode"
    )
    parser.add_argument("--out", type=Path, help=f"file to write, {', '.join(ANIMATION_FORMATS)}")
    parser.add_argument("--start", type=number, default=0.0, help="start [s]")
    parser.add_argument("--duration", type=number, help="duration, by default to the end [s]")
    given = parser.parse_args(words)
    file = run(given.run, given.strategy, given.episode, given.out, given.start, given.duration)
    print(file)
    return 0
