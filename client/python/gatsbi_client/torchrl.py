"""TorchRL over the service: imagined worlds as a `ModelBasedEnvBase`.

    from gatsbi_client.torchrl import ImaginedEnv

    env = ImaginedEnv(client, session.id, 16, object_to_target(pushed, 0.3, 0.2), horizon=15)
    data = env.rollout(15, policy)

State stays on the server, a row of handles for each environment, so the batch is of a fixed size.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ModelBasedEnvBase

from gatsbi_client._sync import Client, Handles
from gatsbi_client.rewards import Reward, action_bounds, neutral_action, visible
from gatsbi_client.types import HandlesStep


class ImaginedEnv(ModelBasedEnvBase):
    """`rows` copies of a session's belief, stepped in imagination.

    `objects` `[rows, MAX, 6]` have zeros in slots that were never filled, `object_ids` `[rows, MAX]` are -1 there. Rows
    are truncated after `horizon` steps. A reset takes one neutral step, because rows are seen only after a step.
    """

    def __init__(
        self, client: Client, session_id: str, rows: int, reward: Reward, *, horizon: int = 15, samples: bool = True,
        device: torch.device | str = "cpu",
    ) -> None:
        # The world model lives elsewhere.
        super().__init__(torch.nn.Identity(), device=device, batch_size=torch.Size([rows]))
        info = client.session(session_id).info
        model = next(each for each in client.models() if each.name == info.model)
        self._client, self._start, self._samples = client, session_id, samples
        self._seed: int | None = None
        self._reward_of, self._horizon, self._neutral = reward, horizon, neutral_action(model)
        self._handles: Handles | None = None
        self._ages = np.zeros(rows, dtype=np.int64)
        low, high = (torch.from_numpy(bound).expand(rows, -1) for bound in action_bounds(model))
        flag = {"shape": (rows, 1), "dtype": torch.bool, "device": device}
        self.observation_spec = Composite(
            objects=Unbounded((rows, model.max_objects, 6), device=device),
            object_ids=Unbounded((rows, model.max_objects), device=device, dtype=torch.int64),
            shape=(rows,),
        )
        self.state_spec = Composite(shape=(rows,))
        self.action_spec = Bounded(low, high, shape=low.shape, device=device, dtype=torch.float32)
        self.reward_spec = Unbounded((rows, 1), device=device)
        self.full_done_spec = Composite(
            {name: Bounded(0, 1, **flag) for name in ("done", "truncated", "terminated")}, shape=(rows,)
        )

    def _reset(self, tensordict: TensorDict | None, **kwargs: Any) -> TensorDict:
        rows = self.batch_size[0]
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        again = np.arange(rows) if chosen is None else np.flatnonzero(chosen.reshape(rows).cpu().numpy())
        restart: list[int] = again.tolist()
        if self._handles is None or len(again) == rows:
            self._begin()
            restart = []
        assert self._handles is not None
        answer = self._handles.step(np.tile(self._neutral, (len(again), 1)), rows=again.tolist(), restart=restart)
        self._ages[again] = 0
        if len(again) == rows:
            return self._seen(answer)
        # Rows that go on show what they showed.
        assert tensordict is not None
        seen = tensordict.select("objects", "object_ids").clone()
        part = self._seen(answer, len(again))
        for name in ("objects", "object_ids"):
            seen[name][torch.from_numpy(again)] = part[name]
        return seen

    def _step(self, tensordict: TensorDict) -> TensorDict:
        assert self._handles is not None
        actions = tensordict["action"].cpu().numpy()
        answer = self._handles.step(actions)
        self._ages += 1
        rewards = self._reward_of(answer.outputs["object_ids"], answer.outputs["objects"], actions)
        truncated = torch.from_numpy(self._ages >= self._horizon).to(self.device)[:, None]
        seen = self._seen(answer)
        seen["reward"] = torch.from_numpy(np.asarray(rewards, dtype=np.float32)).to(self.device)[:, None]
        seen["truncated"], seen["terminated"] = truncated, torch.zeros_like(truncated)
        seen["done"] = truncated.clone()
        return seen

    def _seen(self, answer: HandlesStep, rows: int | None = None) -> TensorDict:
        fields = {
            "objects": torch.from_numpy(visible(answer.outputs)),
            "object_ids": torch.from_numpy(answer.outputs["object_ids"].copy()),
        }
        size = self.batch_size if rows is None else torch.Size([rows])
        return TensorDict(fields, batch_size=size).to(self.device)

    def _begin(self) -> None:
        self._give_back()
        rows = self.batch_size[0]
        drawn = {"samples": rows, "seed": self._seed} if self._samples else {}
        self._handles = self._client.open_handles([self._start] * (1 if self._samples else rows), **drawn)

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed

    def _give_back(self) -> None:
        if self._handles is not None:
            self._handles.close()
            self._handles = None

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Gives the rows back."""
        self._give_back()
        super().close(raise_if_closed=raise_if_closed)
