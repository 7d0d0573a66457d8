"""How environment and agent act on an object (INTER1, INTER2, INTER3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .config import GatsbiConfig
from .glimpses import GlimpseEncoder
from .latents import ObjectLatents
from .layers import Mlp
from .spatial import crop


@dataclass
class Agent:
    """The agent as objects see it."""

    latent: Tensor
    """Mask latent of the agent slot, [B, z_mask]."""
    history: Tensor
    """Prior mask memory of the agent slot, [B, h]."""
    action: Tensor
    """Enhanced action, [B, a]."""

    def u(self) -> Tensor:
        """`u^r`, [B, z_mask + h]."""
        return torch.cat([self.latent, self.history], -1)


class Surroundings(nn.Module):
    """Environment crop and agent feature, merged."""

    def __init__(self, config: GatsbiConfig) -> None:
        super().__init__()
        objects, mixture = config.objects, config.mixture
        hidden, kind = objects.hidden, objects.interaction.kind
        agent, outputs = mixture.z_mask + mixture.hidden, objects.interaction.outputs
        self.bg_attention_encoder = GlimpseEncoder(objects)
        if kind == "inter2":
            u = objects.z_width + hidden
            seen = config.action.enhanced + mixture.hidden + 4 + hidden
            self.agent_pair = Mlp([agent + u, hidden, hidden, hidden])
            self.agent_weight = Mlp([seen, hidden, hidden, 1])
            self.agent_output = Mlp([hidden, hidden, hidden])
        if kind == "inter3":
            self.agent = Mlp([agent, hidden, hidden])
        if kind != "inter1":
            self.ambient = Mlp([2 * hidden, hidden, hidden, outputs])
        self.config = objects

    @staticmethod
    def width(config: GatsbiConfig) -> int:
        """Width of what `forward` gives."""
        interaction = config.objects.interaction
        return config.objects.hidden if interaction.kind == "inter1" else interaction.outputs

    def environment(self, z: Tensor, background: Tensor) -> Tensor:
        """Encoded crops [B, N, hidden] of background [B, 3, H, W] around objects z [B, N, Z]."""
        where = ObjectLatents.split(z, self.config).where
        margin = self.config.updates.environment
        window = torch.cat([where[..., :2] + margin, where[..., 2:]], -1)
        return self.bg_attention_encoder(crop(background, window, self.config.glimpse))

    def forward(self, environment: Tensor, z: Tensor, h: Tensor, agent: Agent | None) -> Tensor:
        """Ambient vectors [B, N, width] from `environment`, z [B, N, Z] and the memory's h [B, N, hidden]."""
        interaction = self.config.interaction
        if interaction.kind == "inter1":
            return environment
        assert agent is not None, "the interaction needs an agent"
        count = z.shape[1]
        if interaction.kind == "inter3":
            effect = self.agent(agent.u()).unsqueeze(1).expand(-1, count, -1)
        else:
            u_r, action, history = (
                x.unsqueeze(1).expand(-1, count, -1) for x in (agent.u(), agent.action, agent.history)
            )
            where = ObjectLatents.split(z, self.config).where
            local = self.agent_pair(torch.cat([u_r, z, h], -1))
            weight = self.agent_weight(torch.cat([action, history, where, h], -1)).sigmoid()
            effect = self.agent_output(weight * local)
        ambient = self.ambient(torch.cat([environment, effect], -1))
        return nn.functional.celu(ambient) if interaction.celu else ambient
