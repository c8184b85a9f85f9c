"""Stage 2 the slow way, for comparison only: one frame batch and one GRUCell call per time step, all in float32."""

import torch
import torch.nn as nn

import aib_belief


class PerStepHistory(nn.Module):
    """The same h as aib_belief.HistoryEncoder from the same weights (one layer, images only), step by step."""

    def __init__(self, history: aib_belief.HistoryEncoder):
        super().__init__()
        self.history = history
        self.cell = nn.GRUCell(history.gru.input_size, history.gru.hidden_size)
        for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
            setattr(self.cell, name, getattr(history.gru, name + "_l0"))

    def forward(self, batch: dict[str, torch.Tensor], **_: object) -> tuple[torch.Tensor, None]:
        """rgb (T, B, H, W, 3) uint8 -> h (T, B, 256)."""
        state, outputs = None, []
        for rgb in batch["rgb"]:
            x = self.history.cnn((rgb.float() - self.history.image_mean) / self.history.image_std)
            state = self.cell(x, state)
            outputs.append(self.history.out(torch.cat([state, x], -1)))
        return torch.stack(outputs), None
