import numpy as np
import pytest

from steadypose.benchmarks.tuning import search


def test_every_search_spends_its_budget_and_no_more() -> None:
    asked: list[dict[str, float]] = []

    def evaluate(point: dict[str, float]) -> dict[str, float]:
        asked.append(point)
        return {"position_mm": np.log(point["a"] / 3.0) ** 2, "acceleration_mm": np.log(point["b"] / 0.2) ** 2}

    found = search({"a": (0.01, 100.0), "b": (0.01, 10.0)}, evaluate, budget=24)
    assert len(asked) == len(found.tried) == 24
    assert all(0.01 <= p["a"] <= 100.0 and 0.01 <= p["b"] <= 10.0 for p in asked)
    assert found.parameters == {key: min(found.tried, key=lambda t: t["position_mm"] + t["acceleration_mm"])[key]
                                for key in ("a", "b")}  # fmt: skip


def test_one_parameter_is_found_within_a_few_per_cent_of_its_range() -> None:
    found = search(
        {"a": (1e-3, 1e3)}, lambda p: {"position_mm": np.log(p["a"] / 7.0) ** 2, "acceleration_mm": 0.0}, budget=18
    )
    assert np.log(found.parameters["a"]) == pytest.approx(np.log(7.0), abs=0.04 * np.log(1e6))


def test_what_has_no_parameters_is_tried_once() -> None:
    found = search({}, lambda _: {"position_mm": 1.0, "acceleration_mm": 1.0}, budget=18)
    assert found.parameters == {}
    assert len(found.tried) == 1
