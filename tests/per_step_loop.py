"""Stage 2 the slow way, for comparison only: one frame batch and one GRUCell call per time step, all in float32."""

import torch
import torch.nn as nn

import aib_belief


def encode_history_per_step(
    history: aib_belief.HistoryEncoder, batch: dict[str, torch.Tensor], bptt_steps: None = None
) -> torch.Tensor:
    """aib_belief.encode_history from the same weights, of one GRU layer and images only."""
    cell = nn.GRUCell(history.gru.input_size, history.gru.hidden_size)
    for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
        setattr(cell, name, getattr(history.gru, name + "_l0"))
    state, outputs = None, []
    for rgb in batch["rgb"]:
        x = history.cnn((rgb.float() - history.image_mean) / history.image_std)
        state = cell(x, state)
        outputs.append(history.out(torch.cat([state, x], -1)))
    return torch.stack(outputs)
