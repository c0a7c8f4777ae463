"""The compiled simulation: kept on disk, safe where it cannot be, absent without numba."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from lcc_rl.drivers import kernel

pytest.importorskip("numba")


def episode(dtype="float32"):
    """Arguments of the kernel: one driver, two candidates, behind a leader at 10 m/s."""
    one = np.dtype(dtype).type
    speed = np.full((1, 30), 10.0, dtype)
    parameters = tuple(np.full((1, 2), x, dtype) for x in (1 / 30, 1.0, 1.0, 0.4, 2.0, 0.0))
    numbers = (0.1, 8.0, 5.0, 0.1, 0.05, 0.0, 1.0, 2.0, 0.025, 1e-12)
    settings = tuple(one(x) for x in numbers)
    total = np.full((2, 1, 2), np.nan, dtype)
    series = (speed, speed.copy(), np.full((1, 30), 20.0, dtype))
    law = (True, None, None, True)
    return *law, *series, np.array([30]), parameters, settings, total


@pytest.fixture
def expected():
    """Sums of the uncompiled function."""
    arguments = episode()
    kernel.squared_errors(*arguments)
    assert (arguments[-1] > 0.0).all()
    return arguments[-1]


def called(function):
    """What a kernel makes of the episode."""
    arguments = episode()
    function(*arguments)
    return arguments[-1]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The user's cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    return tmp_path / "cache"


@pytest.mark.slow
def test_what_was_compiled_is_found_again_and_a_damaged_file_is_no_harm(folder, expected, caplog):
    np.testing.assert_allclose(called(kernel.Kernel("float32")), expected, rtol=1e-5)
    (code,), (index,) = folder.rglob("*.nbc"), folder.rglob("*.nbi")
    second = kernel.Kernel("float32")
    np.testing.assert_array_equal(called(second), called(kernel.Kernel("float32")))
    assert not second.function.stats.cache_misses
    assert caplog.text == ""
    for path in (code, index):
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
        with caplog.at_level("INFO", logger="lcc_rl"):
            np.testing.assert_allclose(called(kernel.Kernel("float32")), expected, rtol=1e-5)
        assert caplog.text.count("for this run only") == 1
        caplog.clear()
        path.write_bytes(whole)


def test_each_precision_has_a_folder_of_its_own(folder):
    names = [kernel._cache_folder(dtype) for dtype in ("float32", "float64", "float32")]
    assert names[0] == names[2] != names[1]
    assert {name.parent for name in names} == {folder / "lcc_rl"}


def test_a_cache_folder_that_cannot_be_written_is_said_in_one_line(folder, expected, caplog):
    folder.write_text("a file where the folder should be")
    with caplog.at_level("INFO", logger="lcc_rl"):
        np.testing.assert_allclose(called(kernel.Kernel("float32")), expected, rtol=1e-5)
    assert caplog.text.count("for this run only") == 1


def test_a_full_disk_is_said_in_one_line(folder, expected, caplog, monkeypatch):
    from numba.core.caching import IndexDataCacheFile

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(IndexDataCacheFile, "_save_data", full)
    with caplog.at_level("INFO", logger="lcc_rl"):
        np.testing.assert_allclose(called(kernel.Kernel("float32")), expected, rtol=1e-5)
    assert "No space left" in caplog.text
    assert not list(folder.rglob("*.nbc"))


def test_the_settings_of_numba_stay_the_users(folder):
    import numba

    before = numba.config.CACHE_DIR
    kernel.Kernel("float32")
    assert before == numba.config.CACHE_DIR


def test_without_numba_there_is_none_and_one_line_says_so(monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "numba", None)
    with caplog.at_level("INFO", logger="lcc_rl"):
        assert kernel.kernel_of.__wrapped__("float32") is None
    assert "without numba, calibrations are several times slower" in caplog.text
    assert len(caplog.records) == 1
