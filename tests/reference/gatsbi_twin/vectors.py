"""Recording of vectors: what the twin computes for given weights, inputs and noise, in one safetensors file.

A file holds, for every step, the inputs (`s0.frame`, `s0.action`, `s0.noise.mask`, ...) and the results
(`s0.mixture.z_mask`, ...), and the same for a training pass (`train.s0.frame`, ..., `train.loss`,
`train.gradients`, `train.statistics`). Its metadata says what each step does and which checkpoint was used. A
result with more than `limit` numbers is thinned to that many, evenly spaced in its flattened form.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor

from . import checkpoint, losses, noise
from .model import Gatsbi, GatsbiState, GatsbiStep

METADATA_KEY = "gatsbi.twin"


@dataclass(frozen=True)
class Step:
    """One step of a case."""

    kind: str
    """`observe`, `imagine` or `skip`."""
    discover: bool | list[bool] = True
    """Observing: whether new objects are looked for, for all rows or for each."""
    noise: str = "sample"
    """`sample` or `mean`; mean noise is not stored."""


@dataclass(frozen=True)
class Objective:
    """The likelihood of a training pass."""

    kind: str
    """`gaussian` (composite image), `mixture` (slots explain their own pixels), `fixed_alpha` (composite with a
    constant alpha)."""
    sigma: float
    alpha: float = 0.0


@dataclass(frozen=True)
class Case:
    """What is recorded."""

    steps: list[Step]
    training: list[Step]
    """Observed steps of one training pass."""
    objective: Objective
    batch: int
    seed: int
    limit: int
    """Numbers kept of a result."""
    gradient_limit: int
    """Numbers kept of a parameter's gradient."""


Tensors = dict[str, Tensor]


def record(case: Case, weights: Path, vectors: Path) -> tuple[float, str]:
    """Runs `case` on the checkpoint `weights` and writes the file `vectors` beside it.

    Returns the largest difference between the results in 32-bit and in 64-bit floats, relative to the largest
    number of each result, and where it is: how much of a disagreement rounding may explain.
    """
    model = checkpoint.load(weights).model
    inputs = draw_inputs(case, model)
    results = run(case, model, inputs)
    double = checkpoint.load(weights).model.double()
    exact = run(case, double, {name: _double(tensor) for name, tensor in inputs.items()})
    gradients, exact_gradients = gradients_of(model), gradients_of(double)
    largest = max(float(gradient.abs().max()) for gradient in exact_gradients.values())
    for name, gradient in gradients.items():
        # What mathematics makes zero (a bias before a batch norm, say) is zero in the vectors too.
        if exact_gradients[name].abs().max() < 1e-10 * largest:
            gradient.zero_()
            exact_gradients[name].zero_()
    stored = {name: thin(tensor, case.limit) for name, tensor in results.items()}
    stored["train.gradients"] = torch.cat([summary(x, case.gradient_limit) for x in gradients.values()])
    metadata = {"checkpoint": weights.name, **asdict(case)}
    save_file(inputs | stored, vectors, {METADATA_KEY: json.dumps(metadata)})
    differences = [(rounding(results[name], exact[name], 1), name) for name in results]
    differences += [(rounding(gradients[name], exact_gradients[name], 1e-30), name) for name in gradients]
    return max(differences)


def draw_inputs(case: Case, model: Gatsbi) -> Tensors:
    """Frames as bytes, actions and noise of all steps."""
    generator = torch.Generator().manual_seed(case.seed)
    size, width = model.config.image_size, model.config.action.dim
    inputs = {}
    # One scene with structure of about the size of objects, that drifts and flickers.
    coarse = torch.rand(case.batch, 3, 6, 6, generator=generator)
    for prefix, step in prefixed(case):
        coarse = (coarse + 0.3 * torch.randn(coarse.shape, generator=generator)).clamp(0, 1)
        inputs[f"{prefix}.action"] = torch.randn(case.batch, width, generator=generator)
        if step.kind == "observe":
            smooth = F.interpolate(coarse, size=(size, size), mode="bicubic").clamp(0, 1)
            grain = 0.1 * torch.rand(smooth.shape, generator=generator)
            inputs[f"{prefix}.frame"] = (255 * (0.9 * smooth + grain)).to(torch.uint8)
        if step.noise == "sample":
            for site, tensor in noise.sample(model.config, case.batch, generator).items():
                if _drawn_at(site, step):
                    inputs[f"{prefix}.noise.{site}"] = tensor
    return inputs


def prefixed(case: Case) -> list[tuple[str, Step]]:
    """All steps with the names their tensors start with."""
    steps = [(f"s{t}", step) for t, step in enumerate(case.steps)]
    return steps + [(f"train.s{t}", step) for t, step in enumerate(case.training)]


def run(case: Case, model: Gatsbi, inputs: Tensors) -> Tensors:
    """All results of a case."""
    results = {}
    model.eval()
    with torch.inference_mode():
        state = model.initial_state(case.batch)
        for t, step in enumerate(case.steps):
            before = state
            state, gives, frame = take(model, case, f"s{t}", step, state, inputs)
            tensors = outcome(model, state, gives)
            if frame is not None:
                tensors |= terms(model, case, before, state, gives, frame)
            results |= {f"s{t}.{name}": tensor.clone() for name, tensor in tensors.items()}
    return results | train(case, model, inputs)


def take(
    model: Gatsbi, case: Case, prefix: str, step: Step, state: GatsbiState, inputs: Tensors
) -> tuple[GatsbiState, GatsbiStep, Tensor | None]:
    """Makes one step; gives the state, the step and the observed frame."""
    action = inputs[f"{prefix}.action"]
    means = noise.mean(model.config, case.batch).items()
    draws = {site: inputs.get(f"{prefix}.noise.{site}", mean.to(action.dtype)) for site, mean in means}
    if step.kind != "observe":
        advance = model.imagine if step.kind == "imagine" else model.skip
        return *advance(state, action, draws), None
    frame = inputs[f"{prefix}.frame"].to(action.dtype) / 255
    discover = torch.tensor(step.discover) if isinstance(step.discover, list) else step.discover
    return *model.observe(state, frame, action, draws, discover, priors=True), frame


def outcome(model: Gatsbi, state: GatsbiState, step: GatsbiStep) -> Tensors:
    """State, latents and images after a step."""
    mixture, objects, rendering = step.mixture, state.objects, model.render(state)
    filled = (objects.ids >= 0).unsqueeze(-1)
    results = {
        "mixture.z_mask": state.mixture.z_mask,
        "mixture.z_comp": state.mixture.z_comp,
        "mixture.mask_raw.mean": mixture.masks.raw.mean,
        "mixture.mask_raw.std": mixture.masks.raw.std,
        "mixture.comp_raw.mean": mixture.comps.raw.mean,
        "mixture.comp_raw.std": mixture.comps.raw.std,
        "mixture.mask_residual": mixture.masks.residual,
        "mixture.comp_residual": mixture.comps.residual,
        "mixture.log_masks": mixture.log_masks,
        "mixture.components": mixture.components,
        "mixture.mu_mix": mixture.mu_mix,
        "objects.ids": objects.ids,
        "objects.next_id": objects.next_id,
        # What an empty slot holds has no meaning.
        "objects.z": objects.z * filled,
        "objects.post.h": objects.post[0] * filled,
        "objects.post.c": objects.post[1] * filled,
        "objects.prior.h": objects.prior[0] * filled,
        "objects.prior.c": objects.prior[1] * filled,
        "image.frame": rendering.over(mixture.mu_mix),
        "image.foreground": rendering.foreground,
        "image.alpha": rendering.alpha,
        "image.object_masks": rendering.masks,
    }
    for family, (h, c) in state.mixture.memory.items():
        results |= {f"mixture.{family}.h": h, f"mixture.{family}.c": c}
    return results


def terms(
    model: Gatsbi, case: Case, before: GatsbiState, state: GatsbiState, step: GatsbiStep, frame: Tensor
) -> Tensors:
    """What compares a step with its frame: priors, KLs, likelihoods, keypoints."""
    mixture, rendering, sigma = step.mixture, model.render(state), case.objective.sigma
    masks, comps = mixture.masks.raw, mixture.comps.raw
    fixed = losses.fixed_alpha_image(rendering.foreground, mixture.mu_mix, case.objective.alpha)
    results = {
        "prior.mask.mean": mixture.mask_prior.mean,
        "prior.mask.std": mixture.mask_prior.std,
        "prior.comp.mean": mixture.comp_prior.mean,
        "prior.comp.std": mixture.comp_prior.std,
        "objects.proposal": step.objects.proposal,
        "kl.mask": losses.latent_kl(masks, mixture.mask_prior),
        "kl.comp": losses.latent_kl(comps, mixture.comp_prior),
        "likelihood.gaussian": losses.gaussian_log_likelihood(frame, rendering.over(mixture.mu_mix), sigma),
        "likelihood.mixture": losses.mixture_log_likelihood(
            frame, mixture.log_masks, mixture.components, sigma
        ),
        "likelihood.fixed_alpha": losses.gaussian_log_likelihood(frame, fixed, sigma),
        "residual_norm": losses.residual_norm(mixture, before.step == 0),
    }
    results |= {f"kl.objects.{name}": term for name, term in step.objects.kl.items()}
    if model.detector is not None:
        keypoints = model.detector(frame)
        gamma = model.detector.gamma(keypoints)
        results |= {
            "keypoints.heatmaps": model.detector.heatmaps(frame),
            "keypoints.points": keypoints,
            "keypoints.gamma": gamma,
        }
        if model.agent_slot is not None:
            agent = mixture.log_masks[:, model.agent_slot].exp()
            results["regression"] = losses.keypoint_regression(gamma, agent)
    return results


def train(case: Case, model: Gatsbi, inputs: Tensors) -> Tensors:
    """One training pass: terms of every frame, the loss and the running statistics after it.

    Leaves the gradients in the model.
    """
    model.train()
    model.zero_grad()
    state = model.initial_state(case.batch)
    results, total = {}, 0.0
    for t, step in enumerate(case.training):
        before = state
        state, gives, frame = take(model, case, f"train.s{t}", step, state, inputs)
        values = terms(model, case, before, state, gives, frame)
        scalars = {name: value for name, value in values.items() if value.dim() == 1}
        results |= {f"train.s{t}.{name}": value.detach().clone() for name, value in scalars.items()}
        penalties = [value for name, value in scalars.items() if not name.startswith("likelihood")]
        total = total - scalars[f"likelihood.{case.objective.kind}"] + sum(penalties)
    loss = total.mean()
    loss.backward()
    tensors = checkpoint.named(model)
    results["train.loss"] = loss.detach()[None]
    statistics = [tensor.flatten() for tensor in tensors.values() if not tensor.requires_grad]
    if statistics:
        results["train.statistics"] = torch.cat(statistics)
    return results


def gradients_of(model: Gatsbi) -> Tensors:
    """Gradients by the parameter's name in the checkpoint, zero where nothing depends on it."""
    gradients = {}
    for name, tensor in checkpoint.named(model).items():
        if tensor.requires_grad:
            gradient = torch.zeros_like(tensor) if tensor.grad is None else tensor.grad
            # The actions of a scene without an agent have no dimensions.
            gradients[name] = gradient.detach() if gradient.numel() else gradient.new_zeros(1)
    return gradients


def summary(gradient: Tensor, limit: int) -> Tensor:
    """Norm, largest magnitude, then the (thinned) numbers of a gradient."""
    return torch.cat([gradient.norm()[None], gradient.abs().max()[None], thin(gradient, limit).flatten()])


def thin(tensor: Tensor, limit: int) -> Tensor:
    """The tensor itself, or `limit` of its numbers where it has more: those at `floor(i * size / limit)`."""
    if tensor.numel() <= limit:
        return tensor.contiguous()
    indices = torch.arange(limit) * tensor.numel() // limit
    return tensor.flatten()[indices]


def rounding(single: Tensor, double: Tensor, least: float) -> float:
    """Largest difference relative to the largest magnitude, or to `least` if that is more."""
    difference = (single.double() - double.double()).abs().max()
    return float(difference / double.double().abs().max().clamp(min=least))


def _double(tensor: Tensor) -> Tensor:
    return tensor.double() if tensor.is_floating_point() else tensor


def _drawn_at(site: str, step: Step) -> bool:
    if site in noise.DISCOVERY:
        return step.kind == "observe" and step.discover is not False
    return site != "presence" or step.kind == "observe"
