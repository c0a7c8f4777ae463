"""The precision option: measured, announced, and refused where unknown."""

from __future__ import annotations

import logging

import pytest
import torch

from lcc_rl.runs.precision import product_error, set_precision


@pytest.fixture(autouse=True)
def restore():
    before = torch.get_float32_matmul_precision()
    yield
    torch.set_float32_matmul_precision(before)


def test_default_is_single_precision_and_silent(caplog) -> None:
    caplog.set_level(logging.INFO, "lcc_rl")
    assert 0.0 < set_precision("highest") < 1e-5
    assert torch.get_float32_matmul_precision() == "highest"
    assert not caplog.messages


def test_reduced_precision_is_set_and_its_error_said(caplog) -> None:
    caplog.set_level(logging.INFO, "lcc_rl")
    error = set_precision("medium")
    assert torch.get_float32_matmul_precision() == "medium"
    assert error == product_error()
    assert f"{error:.1g}" in caplog.messages[0]


def test_bf16_products_are_warned_of(caplog, monkeypatch) -> None:
    monkeypatch.setattr("lcc_rl.runs.precision.product_error", lambda: 4e-3)
    set_precision("medium")
    assert caplog.records[0].levelno == logging.WARNING
