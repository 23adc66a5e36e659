"""Any message that can be: hypothesis strategies, and one plain example of each."""

import dataclasses
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from steadypose.msgs import forms, types
from steadypose.msgs.forms import Array, Integer, ListOf, States
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_EVENTS, POSE_RAW, POSE_TRUTH, POSE_WORLD, TOPICS
from steadypose.msgs.types import Diagnostics, Pose, PoseClean, PoseEvents, PoseRaw, PoseWorld, RawBody


def _of_form(form: Any) -> st.SearchStrategy[Any]:
    if isinstance(form, States):
        return arrays(np.uint8, 22, elements=st.integers(0, form.last))
    if isinstance(form, Array):
        elements: Any = st.floats(width=32 if form.dtype is np.float32 else 64)
        return arrays(form.dtype, form.shape, elements=elements)  # type: ignore[arg-type]
    if isinstance(form, ListOf):
        return st.lists(of(form.kind), max_size=3)
    if isinstance(form, Integer):
        return st.integers(form.low, form.end - 1).map(form.kind)
    text = st.text(max_size=12)
    return {forms.number: st.floats(), forms.text: text, forms.texts: st.dictionaries(text, text, max_size=4)}[form]


@st.composite
def _raw_bodies(draw: st.DrawFn) -> RawBody:
    joints, id = draw(st.integers(0, 40)), draw(_of_form(types.forms_of(RawBody)["id"]))
    return RawBody(id, draw(_of_form(Array(np.float32, (joints, 3)))), draw(_of_form(Array(np.float32, (joints,)))))


def of(kind: type) -> st.SearchStrategy[Any]:
    if kind is RawBody:
        return _raw_bodies()
    if kind is bool:
        return st.booleans()
    own = types.forms_of(kind)
    fields = dataclasses.fields(kind)
    return st.builds(kind, **{f.name: _of_form(own[f.name]) if f.name in own else of(f.type) for f in fields})  # type: ignore[arg-type]


ANY = st.one_of(*(st.tuples(st.just(topic), of(kind)) for topic, kind in TOPICS.items()))


def raw(stamp_ns: int = 0, joints: int = 32, bodies: int = 1) -> PoseRaw:
    positions = np.arange(3 * joints).reshape(joints, 3)
    body = [RawBody(n, positions + n, np.ones(joints)) for n in range(bodies)]
    return PoseRaw(stamp_ns, "camera", "test", "azure_kinect32", Pose.from_up("-y"), False, body)


def clean(stamp_ns: int = 0) -> PoseClean:
    joints = np.arange(66).reshape(22, 3)
    body = types.CleanBody(
        7, joints, np.ones((22, 4)), np.full(22, 2), np.ones(22), 0.5, True, np.ones(22), np.ones(22), joints * np.nan,
        np.zeros(22),
    )  # fmt: skip
    return PoseClean(stamp_ns, "camera", "test", Pose.from_up("-y"), False, 4, [body])


def world(stamp_ns: int = 0) -> PoseWorld:
    joints = np.arange(66).reshape(22, 3)
    body = types.WorldBody(
        id=7, root_position=np.arange(3), root_orientation=np.array([0, 0, 0, 1]), root_velocity=np.arange(3),
        covariance=np.arange(36).reshape(6, 6), positions=joints, rotations=np.ones((22, 4)), state=np.full(22, 3),
        sigma=np.ones(22), contacts=np.ones(8), tracking=types.Tracking.COASTING,
    )  # fmt: skip
    return PoseWorld(stamp_ns, "world", "test", np.array([0, 0, 1, 0]), [body])


def events(stamp_ns: int = 0) -> PoseEvents:
    kind, phase, hand = types.EventKind.POINTS, types.Phase.BEGINS, types.Hand.LEFT
    event = types.Event(7, kind, phase, hand, 0.9, np.array([1, 0, 0]), stamp_ns)
    return PoseEvents(stamp_ns, "world", "test", [event])


def diagnostics(stamp_ns: int = 0) -> Diagnostics:
    values = {"rate": "30.0", "refused.nan": "3"}
    return Diagnostics(stamp_ns, "prior", types.Level.WARN, "3 dropped or refused", values)


EXAMPLES = {
    POSE_RAW: raw(), POSE_CLEAN: clean(), POSE_WORLD: world(), POSE_EVENTS: events(), POSE_TRUTH: world(),
    DIAGNOSTICS: diagnostics(),
}  # fmt: skip
