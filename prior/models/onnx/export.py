"""``python -m steadypose.prior.models.onnx.export``: ONNX files beside the weights, for C++; see other_languages.md."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import onnx
import torch
from onnx import ModelProto, helper, numpy_helper
from torch import nn

from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.models import weights_io
from steadypose.prior.models.contacts.network import ContactConfig, ContactNet
from steadypose.prior.models.hgvae.config import JOINT_NODES, HGVAEConfig
from steadypose.prior.models.hgvae.faults import load_fault_net
from steadypose.prior.models.hgvae.network import HGVAE
from steadypose.prior.models.hmvae.config import HMVAEConfig
from steadypose.prior.models.hmvae.network import HMVAE
from steadypose.prior.models.mixture.bank import EXPERTS
from steadypose.prior.models.mixture.features import FEATURES
from steadypose.prior.models.mixture.form import OUTPUTS
from steadypose.prior.models.mixture.network import MixtureConfig, MixtureNet
from steadypose.prior.models.occlusion.candidates import FEATURES as OCCLUSION_FEATURES
from steadypose.prior.models.occlusion.network import OcclusionConfig, OcclusionNet
from steadypose.prior.models.onnx.modules import (
    Contacts,
    Correction,
    Faults,
    Mixture,
    Occlusion,
    Reconstruction,
    Refinement,
    RootMotion,
)
from steadypose.prior.models.root_velocity.config import TrajectoryConfig
from steadypose.prior.models.root_velocity.network import TrajectoryNet
from steadypose.prior.models.sensor_bias.features import HISTORY, CorrectionConfig
from steadypose.prior.models.sensor_bias.network import CorrectionNet
from steadypose.prior.models.torch_weights import load_network

SMALL = 64
"""Numbers up to which a constant stays in single precision: nothing is gained by halving it."""


@dataclass(frozen=True)
class Form:
    """A network, and the inputs and outputs of its ONNX file.

    Attributes:
        module: what is exported, in evaluation.
        inputs: name to shape, without the first axis, the batch, which is of any size.
        outputs: names.
    """

    module: nn.Module
    inputs: dict[str, tuple[int, ...]]
    outputs: tuple[str, ...]


def _mixture() -> Form:
    network = load_network(MixtureNet, lambda config: MixtureConfig(**config), "default", "mixture")
    sizes = network.config
    bank = {
        "features": (22, FEATURES),
        "experts": (22, EXPERTS, 3),
        "heading": (2,),
        "scale": (),
        "gap": (22,),
        "between": (22,),
    }
    own, body = (22, sizes.own), (sizes.body,)
    memory = {"own": own, "own_weight": own, "body": body, "body_weight": body, "written": (22, OUTPUTS)}
    return Form(Mixture(network), {**bank, **memory}, ("positions", "sigma", *(f"{name}_next" for name in memory)))


def _occlusion() -> Form:
    network = load_network(OcclusionNet, OcclusionConfig.from_dict, "default", "occlusion")
    return Form(Occlusion(network), {"features": (OCCLUSION_FEATURES,), "joint": ()}, ("weights", "sigma"))


def _refinement() -> Form:
    network = load_network(HMVAE, HMVAEConfig.from_dict, "default", "hmvae")
    return Form(Refinement(network), {"rotations": (network.window, 22, 6)}, ("decoded",))


def _reconstruction() -> Form:
    network = load_network(HGVAE, HGVAEConfig.from_dict, "default", "hgvae")
    tracks = (JOINT_NODES, network.config.frames)
    inputs = {"tracks": tracks, "confidence": tracks, "bias_sigma": ()}
    return Form(Reconstruction(network), inputs, ("reconstructed", "sigma"))


def _faults() -> Form:
    network = load_fault_net("default")
    tracks = (JOINT_NODES, network.config.frames)
    inputs = dict.fromkeys(("tracks", "reconstructed", "sigma", "confidence"), tracks)
    return Form(Faults(network), {**inputs, "sensor_sigma": ()}, ("odds",))


def _root_motion() -> Form:
    network = load_network(TrajectoryNet, TrajectoryConfig.from_dict, "default", "trajectory")
    outputs = ("velocity", "log_sigma", "contact_logits")
    return Form(RootMotion(network), {"joints": (network.config.context, 22, 3)}, outputs)


def _contacts() -> Form:
    network = load_network(ContactNet, ContactConfig.from_dict, "default", "contacts")
    inputs = {"positions": (22, 3), "before": (22, 3), "dt": (), "yaw": (), "sigma": (22,), "root_seen": ()}
    inputs |= {"ground": (len(CONTACT_JOINTS),), "state": (network.config.hidden,)}
    return Form(Contacts(network), inputs, ("load", "rest", "new_state"))


def _correction() -> Form:
    network = load_network(CorrectionNet, CorrectionConfig.from_dict, "kinect_v2", "correction")
    return Form(Correction(network), {"history": (len(HISTORY), 22, 3), "camera": (3,)}, ("correction",))


FORMS: dict[str, Callable[[], Form]] = {
    "mixture-default": _mixture,
    "occlusion-default": _occlusion,
    "hmvae-default": _refinement,
    "hgvae-default": _reconstruction,
    "hgvae-default.faults": _faults,
    "trajectory-default": _root_motion,
    "contacts-default": _contacts,
    "correction-kinect_v2": _correction,
}
"""by the name of the file"""


def export(form: Form) -> bytes:
    """The ONNX file of a network: the same bytes for the same weights and versions of torch and onnx."""
    for name in ("torch.onnx", "onnxscript", "onnx_ir"):
        logging.getLogger(name).setLevel(logging.ERROR)  # of libraries that are not there
    bodies = torch.export.Dim("bodies")
    examples = tuple(torch.rand(2, *shape) + 0.1 for shape in form.inputs.values())
    with torch.no_grad(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "# The axis name: bodies")  # all inputs share it
        program = torch.onnx.export(
            form.module.eval(),
            examples,
            input_names=list(form.inputs),
            output_names=list(form.outputs),
            dynamic_shapes=tuple({0: bodies} for _ in examples),
            opset_version=20,
            dynamo=True,
            verbose=False,
        )
    assert program is not None  # of the exporter by torch.export
    return _plain(program.model_proto).SerializeToString(deterministic=True)


def _plain(model: ModelProto) -> ModelProto:
    """The model with its weights in half precision, which is how they were kept, and without traces of its making.

    What half precision cannot hold stays: the answers do not change.
    """
    graph, casts = model.graph, []
    for number, initializer in enumerate(graph.initializer):
        values = numpy_helper.to_array(initializer)
        if values.dtype != np.float32 or values.size <= SMALL:
            continue
        with np.errstate(over="ignore"):
            half = values.astype(np.float16)
        if not np.array_equal(half.astype(np.float32), values):
            continue
        kept = f"{initializer.name}.half"
        casts.append(helper.make_node("Cast", [kept], [initializer.name], to=onnx.TensorProto.FLOAT))
        graph.initializer[number].CopyFrom(numpy_helper.from_array(half, kept))
    nodes = [*casts, *graph.node]
    for number, node in enumerate(nodes):
        node.name, node.doc_string = f"{node.op_type}_{number}", ""
        del node.metadata_props[:]
    del graph.node[:], graph.value_info[:], graph.metadata_props[:], model.metadata_props[:]
    graph.node.extend(nodes)
    for value in (*graph.input, *graph.output, *graph.initializer):
        value.doc_string = ""
        del value.metadata_props[:]
    graph.name, model.producer_name, model.producer_version = "steadypose", "steadypose", ""
    onnx.checker.check_model(model, full_check=True)
    return model


def main() -> None:
    """Write the file of every network that ships."""
    for name, form in FORMS.items():
        path = weights_io.WEIGHTS / f"{name}.onnx"
        path.write_bytes(export(form()))
        print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
