import dataclasses
from collections import Counter

import numpy as np
import pytest
from scipy.stats import norm
from tests.helpers.bodies import PERIOD_NS, raw, waving
from tests.helpers.crossings import MANIFEST, all_hidden, score, watch

from steadypose.prior.body.skeleton import J
from steadypose.prior.clean.identify import Identify, _bone_lengths, _place_score, _unobserved
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import IdentifySettings, PriorSettings
from steadypose.prior.sim.streams import read_manifest

START_NS = 1_700_000_000_000_000_000
FRAMES = 120
SHORT, TALL = waving(FRAMES, scale=0.9), waving(FRAMES, scale=1.1)


def stage(rows: int = 8, **settings: float) -> Identify:
    return Identify(IdentifySettings(enabled=True, **settings), rows, Counter())


def ids(identify: Identify, index: int, *bodies: np.ndarray) -> list[int | None]:
    joints = np.array(bodies).reshape(-1, 22, 3)
    return identify.update(START_NS + index * PERIOD_NS, joints, np.ones(joints.shape[:2]))


def at(body: np.ndarray, index: int, x: float, y: float = 0.0) -> np.ndarray:
    return body[index] + [x, y, 0.0]


def test_the_order_of_bodies_in_a_frame_does_not_matter() -> None:
    identify, rng, names = stage(), np.random.default_rng(0), []
    for index in range(30):
        bodies = [at(SHORT, index, 0.0), at(TALL, index, 1.0), at(SHORT, index, 2.0)]
        order = rng.permutation(3)
        given = ids(identify, index, *(bodies[k] for k in order))
        names.append([given[k] for k in np.argsort(order)])
    assert sorted(names[-1], key=str) == [1, 2, 3]
    assert names[10:] == [names[-1]] * 20


def test_somebody_new_gets_an_id_after_the_birth_delay_and_a_ghost_none() -> None:
    identify = stage(birth=0.25)
    given = [ids(identify, index, at(SHORT, index, 0.0)) for index in range(12)]
    assert given == [[None]] * 8 + [[1]] * 4
    ghosts = [ids(identify, 12 + k, at(SHORT, 12 + k, 0.0), at(TALL, k, 2.0)) for k in range(5)]
    assert ghosts == [[1, None]] * 5
    assert [ids(identify, 40 + k, at(SHORT, 40 + k, 0.0)) for k in range(20)] == [[1]] * 20


def test_who_walks_behind_a_pillar_comes_out_as_the_same() -> None:
    identify, given = stage(), []
    for index in range(60):  # 1 m/s
        given = ids(identify, index, *([] if 20 <= index < 50 else [at(SHORT, index, index / 30)]))
    assert given == [1]


def test_who_is_away_for_longer_than_death_comes_back_as_somebody_new() -> None:
    for away, expected in ((40, 1), (80, 2)):
        identify, given = stage(death=2.0), []
        for index in [*range(20), *range(20 + away, 40 + away)]:
            if index == 20 + away:
                for empty in range(20, index):
                    ids(identify, empty)
            given = ids(identify, index, at(SHORT, index % FRAMES, 0.0))
        assert given == [expected]


def test_where_places_do_not_tell_bones_do() -> None:
    """Two stand side by side, vanish for a second, and have changed places when they are seen again."""
    for changed in (False, True):
        identify, given, again = stage(), [], []
        for index in range(60):
            given = ids(identify, index, at(SHORT, index, 0.0), at(TALL, index, 0.5))
        assert sorted(given, key=str) == [1, 2]
        for index in range(60, 100):
            places = (0.5, 0.0) if changed else (0.0, 0.5)
            seen = [] if index < 90 else [at(SHORT, index, places[0]), at(TALL, index, places[1])]
            again = ids(identify, index, *seen)
        assert again == given


def test_a_body_detected_twice_is_one_person() -> None:
    identify, given = stage(), []
    for index in range(30):
        given = ids(identify, index, at(SHORT, index, 0.0), at(SHORT, index, 0.05, 0.05))
    assert sorted(given, key=str) == [1, None]


def test_what_a_hostile_source_sends_is_survived_and_counted() -> None:
    counters: Counter[str] = Counter()
    identify = Identify(IdentifySettings(enabled=True), 8, counters)
    crowd, given = [at(SHORT, 0, float(k)) for k in range(50)], []
    for index in range(12):
        given = ids(identify, index, *crowd)
    assert given == [*range(1, 9)] + [None] * 42
    assert counters["too_many_bodies"] == 12 * 42
    nothing = np.full((22, 3), np.nan)
    assert ids(identify, 12, nothing, nothing) == [None, None]
    assert ids(identify, 5, crowd[0]) == [None]  # stamps went back: a new stream
    assert ids(identify, 10**9, crowd[0]) == [None]  # and far ahead
    assert [ids(identify, 10**9 + 1 + k, crowd[0])[0] for k in range(9)][-1] == 9, "ids are never given again"


def test_a_place_is_as_likely_as_normal_errors_make_it_against_somebody_new() -> None:
    """Errors of 0.1 m a frame, in height of 0.3 m at most besides; a new person in a hundred cubic metres."""
    away, across, up = np.array([0.2, -0.1, 0.15]), np.hypot(0.4, 0.1), np.hypot(0.3, 0.1)
    expected = norm.logpdf(away, 0.0, [across, across, up]).sum() - np.log(0.01)
    assert _place_score(away, np.array(0.4)) == pytest.approx(expected)
    assert _place_score(np.full(3, np.nan), np.array(0.4)) == -np.inf


def test_who_is_out_of_sight_is_expected_to_lose_the_velocity_within_a_second() -> None:
    """A velocity of 0.6 m/s along an axis that is forgotten in 1 s: its covariance, integrated twice."""
    seconds = np.array([0.5, 3.0])
    expected, sigma = _unobserved(np.zeros((2, 3)), seconds[:, None] * [1.0, 0.0, 0.0], np.full(2, 99.0), seconds)
    np.testing.assert_allclose(expected[:, 0], 1.0 - np.exp(-seconds))
    for stated, duration in zip(sigma, seconds, strict=True):
        t = np.linspace(0.0, duration, 1001)
        spread = 0.36 * np.exp(-np.abs(t[:, None] - t)).mean() * duration**2
        assert stated == pytest.approx(np.sqrt(0.1**2 + spread), rel=1e-3)
    assert _unobserved(np.zeros((1, 3)), np.zeros((1, 3)), np.full(1, 0.02), np.ones(1))[1] == [0.02]


def test_bones_are_the_mean_of_both_sides_that_are_well_seen_and_no_giants() -> None:
    body, confidence = SHORT[0].copy(), np.ones((1, 22))
    whole = _bone_lengths(body[None], confidence)[0]
    generic = np.array([0.415, 0.41, 0.275, 0.25, 0.36, 0.50])
    np.testing.assert_allclose(whole, 0.9 * generic, rtol=0.06)
    body[J["left_ankle"]] += (body[J["left_ankle"]] - body[J["left_knee"]]) * 0.2  # a fifth longer on one side
    assert _bone_lengths(body[None], confidence)[0] == pytest.approx(whole * [1.0, 1.1, 1.0, 1.0, 1.0, 1.0])
    confidence[0, J["left_ankle"]] = 0.29
    body[J["right_wrist"]] += 0.6
    assert _bone_lengths(body[None], confidence)[0] == pytest.approx(whole)
    confidence[0, [J["left_hip"], J["right_hip"]]] = 0.0
    assert np.flatnonzero(np.isnan(_bone_lengths(body[None], confidence)[0])).tolist() == [0]


def test_longer_bones_are_somebody_elses_by_their_likelihood() -> None:
    """A length errs by 5 cm in a second, people differ by a tenth of it; one bone never tells by more than e^3."""
    identify = stage()
    identify._lengths[:2], identify._lengths_s[:2] = 0.4, [[4.0] * 6, [0.5] * 6]
    identify._lengths_s[:, 2:] = 0.0  # of two bones alone
    identify._lengths[1, :2] = 0.45, 1.4
    same = 0.05**2 / 4 + 0.05**2
    found = identify._length_score(np.array([0]), np.array([1]))[0, 0]
    other = same + 2 * (0.1 * 0.415) ** 2
    assert found == pytest.approx(norm.logpdf(0.05, 0.0, same**0.5) - norm.logpdf(0.05, 0.0, other**0.5) - 3.0)


def test_the_pipeline_gives_unnumbered_bodies_ids_and_passes_a_trackers_on() -> None:
    def run(**settings: object) -> list[set[int]]:
        pipeline = PriorPipeline(PriorSettings.from_dict(settings))
        messages = []
        for index in range(40):
            bodies = [SHORT[index], TALL[index] + [1.5, 0.0, 0.0]]
            if index % 2:
                bodies.reverse()
            messages += pipeline.process(raw(START_NS + index * PERIOD_NS, dict(zip((7, 8), bodies, strict=True))))
        return [{b.id for b in m.bodies if b.positions[0, 0] > 0.75} for m in messages if m.bodies]

    assert run(identify={"enabled": True})[-20:] in ([{1}] * 20, [{2}] * 20)
    assert len({tuple(i) for i in run()}) > 1, "the source's ids are passed on as they are"


@pytest.mark.slow
def test_nobody_changes_ids_in_the_crossing_streams() -> None:
    """That of sim_data, and one in which the hindmost is hidden for two seconds and, then, both at once."""
    filmed = read_manifest(MANIFEST)["crossing"]
    hidden = watch(dataclasses.replace(filmed, script="hidden_crossing"))
    for frames in (watch(filmed), hidden, all_hidden(hidden)):
        switches, named = score(frames, IdentifySettings(enabled=True))
        assert switches == 0
        assert named > 0.85
