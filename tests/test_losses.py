"""Closed forms of every loss, the algorithm's lines, and where gradients go."""

import math
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn as nn
from torch.distributions import Normal

import aib_belief
import aib_repr
import ppo_aib
import ppo_baseline
import ppo_believer
from conftest import ROOT, TOY, spaces, train

sys.path.append(str(ROOT / "benchmark"))
import belief as probes  # noqa: E402

IMAGE = [36, 36, 3]
CONFIG = {"image_shape": IMAGE, "joints_dim": 7, "u_dim": 4, "z_dim": 5}
T, B, A = 6, 3, 2
SELECT, REPORT = slice(0, 20), slice(20, 40)


def belief_model(head: str = "flow", config: dict = CONFIG) -> nn.ModuleDict:
    torch.manual_seed(0)
    model = nn.ModuleDict({"belief": aib_belief.AIBBelief(config)})
    model["posterior"] = aib_belief.GaussianMLP(config["u_dim"] + 256, [32], config["z_dim"], min_std=0.1)
    model["head"] = aib_belief.mlp([2 * config["z_dim"] + (A + 1) * (head == "flow"), 32, A])
    model["teacher"] = aib_belief.Teacher(config["u_dim"])
    model["teacher"].eval()
    nn.init.orthogonal_(model["belief"].history.arm.weight)  # starts at 0
    return model


def belief_batch(steps: int = T) -> dict[str, torch.Tensor]:
    torch.manual_seed(1)
    return {
        "rgb": torch.randint(0, 256, (steps + 1, B, *IMAGE), dtype=torch.uint8),
        "joints": torch.randn(steps + 1, B, 7),
        "u": torch.randn(steps + 1, B, CONFIG["u_dim"]),
        "actions": torch.rand(steps, B, A) * 2 - 1,
        "cue": torch.zeros(B, 1),
    }


def losses_args(**changes: object) -> SimpleNamespace:
    defaults = dict(beta=1.0, action_head="flow", fm_latent="mean", action_lambda=1.0, z_dim=CONFIG["z_dim"])
    defaults |= dict(image_mask=0.0, warmup_updates=0, prior_nll=0.0)
    return SimpleNamespace(**{**defaults, **changes})


REPR_ARGS = SimpleNamespace(reward_coef=10.0, state_coef=0.3, obs_coef=0.03, kl_coef=0.03)


# ---------------------------------------------------------------- stage 1


def repr_model_and_batch() -> tuple[nn.ModuleDict, dict[str, torch.Tensor]]:
    torch.manual_seed(0)
    phi, psi = aib_repr.StateEncoder(5, 4), aib_repr.ObservationEncoder(tuple(IMAGE), 7, 4)
    model = nn.ModuleDict({"phi": phi, "psi": psi, "g": aib_repr.Predictor(4, A)})
    batch = {"actions": torch.rand(B, A), "rewards": torch.randn(B)}
    for name in ("", "next_"):
        batch[name + "rgb"] = torch.randint(0, 256, (B, *IMAGE), dtype=torch.uint8)
        batch[name + "joints"], batch[name + "state"] = torch.randn(B, 7), torch.randn(B, 5)
    return model, batch


def test_algorithm_1_line_by_line() -> None:
    model, batch = repr_model_and_batch()
    torch.manual_seed(3)
    losses = aib_repr.repr_losses(model, batch, REPR_ARGS)
    torch.manual_seed(3)
    q_s, q_o = model["phi"](batch["state"]), model["psi"](batch["rgb"], batch["joints"])
    u_s = q_s.mean + q_s.stddev * torch.randn(B, 4)
    u_o = q_o.mean + q_o.stddev * torch.randn(B, 4)
    r, s, o = model["g"](u_s, u_o, batch["actions"])
    s_next, o_next = model["phi"](batch["next_state"]).mean, model["psi"](batch["next_rgb"], batch["next_joints"]).mean
    assert torch.allclose(losses["reward"], ((batch["rewards"] - r) ** 2).mean(), atol=1e-5)
    assert torch.allclose(losses["state"], ((s_next - s) ** 2).sum(1).mean(), atol=1e-5)
    assert torch.allclose(losses["obs"], ((o_next - o) ** 2).sum(1).mean(), atol=1e-5)
    kl = 0.5 * (q_s.mean**2 + q_s.variance - 1 - q_s.variance.log())
    assert torch.allclose(losses["kl"], kl.mean(), atol=1e-5), "over dimensions, too"
    total = 10 * losses["reward"] + 0.3 * losses["state"] + 0.03 * losses["obs"] + 0.03 * losses["kl"]
    assert torch.allclose(losses["total"], total)
    model["g"].reward_mean.fill_(0.5), model["g"].reward_std.fill_(2.0)
    torch.manual_seed(3)
    again = aib_repr.repr_losses(model, batch, REPR_ARGS)
    assert torch.allclose(again["reward"], (((batch["rewards"] - 0.5) / 2 - r) ** 2).mean(), atol=1e-5)


def test_stage_1_targets_stop_the_gradient() -> None:
    model, batch = repr_model_and_batch()
    batch["next_state"].requires_grad_(True)
    batch["next_joints"].requires_grad_(True)
    losses = aib_repr.repr_losses(model, batch, REPR_ARGS)
    assert losses["state"].requires_grad and losses["obs"].requires_grad
    losses["total"].backward()
    assert batch["next_state"].grad is None and batch["next_joints"].grad is None


def test_transitions_lie_within_an_episode_and_each_is_learnt_from_once_an_epoch(
    toy_task: Path, toy_stages: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = toy_stages / f"{TOY}__aib_repr__1" / "dataset"
    arrays = {file.stem: np.load(file) for file in dataset.glob("*.npy")}
    batch = aib_repr.TransitionDataset(dataset, "cpu")(np.array([0, 9, 10, 199]))
    for row, (episode, t) in enumerate([(0, 0), (0, 9), (1, 0), (19, 9)]):
        for name in ("rgb", "joints", "state", "actions", "rewards"):
            assert np.array_equal(batch[name][row], arrays[name][episode, t]), name
        for name in ("rgb", "joints", "state"):
            assert np.array_equal(batch[f"next_{name}"][row], arrays[name][episode, t + 1]), name
    read, transitions = [], aib_repr.TransitionDataset.__call__
    patched = lambda self, index: read.append(index) or transitions(self, index)  # noqa: E731
    monkeypatch.setattr(aib_repr.TransitionDataset, "__call__", patched)
    train(aib_repr, num_episodes=20, epochs=2, batch_size=54)
    epochs, held_out = [np.concatenate(read[:3]), np.concatenate(read[4:7])], [read[3], read[7]]
    assert all(sorted(epoch) == list(range(160)) for epoch in epochs), "of 16 episodes of 10 steps"
    assert not np.array_equal(*epochs) and not np.array_equal(epochs[0], np.arange(160))
    assert all(set(index) <= set(range(160, 200)) for index in held_out)


# ---------------------------------------------------------------- stage 2


def test_elbo_terms_are_the_closed_forms() -> None:
    model, u, h = belief_model(), torch.randn(T, B, 4), torch.randn(T, B, 256)
    torch.manual_seed(2)
    nll, kl, z, mean = aib_belief.elbo_terms(model["belief"], model["posterior"], u, h)
    q, p = model["posterior"](torch.cat([u, h], -1)), model["belief"].prior(h)
    d = model["belief"].decoder(torch.cat([z, h], -1))
    direct = (p.stddev / q.stddev).log() + (q.variance + (q.mean - p.mean) ** 2) / (2 * p.variance) - 0.5
    assert torch.allclose(kl, direct.sum(-1), atol=1e-4)
    direct = 0.5 * ((u - d.mean) / d.stddev) ** 2 + d.stddev.log() + 0.5 * math.log(2 * math.pi)
    assert torch.allclose(nll, direct.sum(-1), atol=1e-4)
    assert torch.equal(mean, q.mean) and nll.shape == kl.shape == (T, B)


@pytest.mark.parametrize("tau", [0.0, 0.3, 1.0])
def test_flow_matching_interpolates_from_noise_to_action(tau: float) -> None:
    seen, action, noise = [], torch.rand(B, A), torch.randn(B, A)
    z, z_next = torch.randn(B, 5), torch.randn(B, 5)

    def head(x: torch.Tensor) -> torch.Tensor:
        seen.append(x)
        return torch.zeros(B, A)

    loss = aib_belief.flow_matching_loss(head, action, z, z_next, noise, torch.full((B, 1), tau))
    a_tau = (1 - tau) * noise + tau * action
    assert torch.allclose(seen[0], torch.cat([a_tau, torch.full((B, 1), tau), z, z_next], -1))
    assert torch.allclose(loss, ((action - noise) ** 2).sum(-1))


def test_total_loss_adds_up_and_ablations_leave_their_term_out() -> None:
    batch = belief_batch()
    for head, terms in (("flow", {"nll", "kl", "action"}), ("mse", {"nll", "kl", "action"}), ("none", {"nll", "kl"})):
        args = losses_args(action_head=head, beta=0.5, action_lambda=0.1)
        losses = aib_belief.belief_losses(belief_model(head), batch, args)
        assert losses.keys() == terms | {"total"}, "the paper's alone"
        total = losses["nll"] + 0.5 * losses["kl"] + 0.1 * losses.get("action", 0)
        assert torch.allclose(losses["total"], total)


@pytest.mark.parametrize("head, latent", [("flow", "mean"), ("flow", "sample"), ("mse", "mean")])
def test_what_the_action_head_sees_of_the_posterior(head: str, latent: str) -> None:
    model, batch = belief_model(head), belief_batch()
    torch.manual_seed(2)
    loss = aib_belief.belief_losses(model, batch, losses_args(action_head=head, fm_latent=latent))["action"]
    torch.manual_seed(2)
    h = aib_belief.encode_history(model["belief"].history, batch)[0]
    q = model["posterior"](torch.cat([batch["u"], h], -1))
    sample, action = q.rsample(), batch["actions"]
    z = {"mean": q.mean, "sample": sample}[latent]
    noise, tau = torch.randn_like(action), torch.rand_like(action[..., :1])
    expected = {
        "flow": lambda: aib_belief.flow_matching_loss(model["head"], action, z[:-1], z[1:], noise, tau).mean(),
        "mse": lambda: (model["head"](torch.cat([z[:-1], z[1:]], -1)) - action).square().sum(-1).mean(),
    }
    assert torch.allclose(loss, expected[head]())


def test_flow_loss_shapes_the_posterior_and_the_prior_only_through_the_kl() -> None:
    model, batch = belief_model(), belief_batch()
    losses = aib_belief.belief_losses(model, batch, losses_args())

    def moved(loss: torch.Tensor, module: nn.Module) -> bool:
        grads = torch.autograd.grad(loss, list(module.parameters()), retain_graph=True, allow_unused=True)
        return any(g is not None and g.abs().sum() > 0 for g in grads)

    assert moved(losses["action"], model["posterior"]) and moved(losses["action"], model["head"])
    assert moved(losses["nll"], model["posterior"]), "z is a sample that lets the gradient through"
    assert not moved(losses["action"], model["belief"].prior)
    assert not moved(losses["nll"], model["belief"].prior)
    assert moved(losses["kl"], model["belief"].prior)
    samples = aib_belief.belief_losses(model, batch, losses_args(fm_latent="sample"))
    assert moved(samples["action"], model["posterior"])
    believer = nn.ModuleDict({**model, "belief": ppo_believer.BelieverBelief(CONFIG)})
    assert moved(ppo_believer.believer_losses(believer, batch, losses_args())["nll"], model["posterior"])


def test_believer_has_a_fixed_prior() -> None:
    torch.manual_seed(0)
    belief, h = ppo_believer.BelieverBelief(CONFIG), torch.randn(T, B, 256)
    model = nn.ModuleDict({**belief_model(), "belief": belief})
    batch, args = belief_batch(), losses_args(beta=0.5)
    torch.manual_seed(1)
    losses = ppo_believer.believer_losses(model, batch, args)
    torch.manual_seed(1)
    history = ppo_believer.encode_history(belief.history, batch)[0]
    q = model["posterior"](torch.cat([batch["u"], history], -1))
    nll = -belief.decoder(torch.cat([q.rsample(), history], -1)).log_prob(batch["u"]).sum(-1).mean()
    kl = (0.5 * (q.mean**2 + q.stddev**2 - 1) - q.stddev.log()).sum(-1).mean()
    assert torch.allclose(losses["nll"], nll) and torch.allclose(losses["kl"], kl)
    assert torch.allclose(losses["total"], nll + 0.5 * kl)
    z = torch.randn(B, 30, 5)
    d = belief.decoder(torch.cat([z, h[0, :, None].expand(-1, 30, -1)], -1))
    assert torch.allclose(belief.decode(h[0], z).mean, d.mean, atol=1e-5)


def test_held_out_prior_likelihood_is_that_of_the_particles_mixture() -> None:
    model, batch = belief_model(), belief_batch()
    belief, posterior = model["belief"], model["posterior"]
    seen = probes.encode(belief, posterior, lambda index: batch, torch.zeros(B, 1), np.arange(B))
    torch.manual_seed(0)
    with torch.no_grad():
        h = aib_belief.encode_history(belief.history, batch)[0]
        aib_belief.elbo_terms(belief, posterior, batch["u"], h)  # draws its noise first
        p, noise = belief.prior(h), torch.randn(T + 1, B, 30, 5)
        density, means = torch.zeros(T + 1, B), torch.zeros(T + 1, B, 4)
        for i in range(30):
            d = belief.decoder(torch.cat([p.mean + p.stddev * noise[:, :, i], h], -1))
            density += d.log_prob(batch["u"]).sum(-1).exp() / 30
            means += d.mean / 30
    assert torch.allclose(seen["nll_prior"], -density.log().T, atol=1e-4)
    assert torch.allclose(seen["u_prior"], means.transpose(0, 1), atol=1e-5)


def test_sequence_and_step_path_agree() -> None:
    history, batch, hidden = belief_model()["belief"].history, belief_batch(), None
    whole, memory = aib_belief.encode_history(history, batch)
    assert whole.shape == (T + 1, B, 256) and memory.shape == (T + 1, B, 32)
    for t in range(T + 1):
        if t:
            assert torch.allclose(history.code(hidden[:, :256]), memory[t], atol=1e-5), (
                "of the state before the picture"
            )
        h, hidden = history(batch["rgb"][t], batch["joints"][t], hidden)
        assert torch.allclose(h, whole[t], atol=1e-5)


def test_gradients_reach_the_first_frame_and_come_in_chunks_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    gradients = []
    for frames in (2048, 5):
        monkeypatch.setattr(aib_belief, "IMAGE_CHUNK", frames)
        model, batch = belief_model(), belief_batch()
        aib_belief.belief_losses(model, batch, losses_args(prior_nll=1.0))["total"].backward()
        gradients.append([x.grad for name, x in model.named_parameters() if x.grad is not None])
    assert len(gradients[0]) > 20
    assert all(torch.allclose(one, other, rtol=1e-4, atol=1e-6) for one, other in zip(*gradients, strict=True))
    history, batch = belief_model()["belief"].history, belief_batch(59)
    images = batch["rgb"].float().requires_grad_()
    aib_belief.encode_history(history, {**batch, "rgb": images})[0][-1].sum().backward()
    assert images.grad[0].abs().sum() > 0


def test_attention_finds_a_patch_by_its_look_wherever_it_is() -> None:
    history, rgb = belief_model()["belief"].history, torch.zeros(2, *IMAGE, dtype=torch.uint8)
    rgb[0, 4:6, 10:12, 0] = rgb[1, 30:32, 20:22, 0] = 255  # a patch is 2 x 2 pixels here
    keys, contents, keypoints = history.image(rgb)
    assert keys.shape == (2, 18**2, 16) and contents.shape == (2, 18**2, 10) and keypoints.shape == (2, 48)
    patches = [2 * 18 + 5, 15 * 18 + 10]
    assert torch.allclose(keys[0, patches[0]], keys[1, patches[1]]), "a key holds no coordinates"
    assert torch.allclose(keys[0, 0], keys[1, 99]) and not torch.allclose(keys[0, 0], keys[0, patches[0]])
    history.query = nn.Identity()  # the first half of the memory asks for the first picture's patch
    memory = torch.cat([keys[0, patches[0]].expand(2, -1), torch.randn(2, 16)], -1)
    place, weights = history.ask(memory, keys, contents)
    query, key = (nn.functional.layer_norm(x, [16]) for x in (memory[:, :16], keys))
    assert torch.allclose(weights, torch.einsum("bk,bnk->bn", query, key).softmax(-1), atol=1e-5)
    assert weights.argmax(-1).tolist() == patches
    assert torch.allclose(place, torch.einsum("bn,bnc->bc", weights, contents), atol=1e-5)
    row_and_column = [[2 / 17 * 2 - 1, 5 / 17 * 2 - 1], [15 / 17 * 2 - 1, 10 / 17 * 2 - 1]]
    assert torch.allclose(contents[[0, 1], patches, :2], torch.tensor(row_and_column))


def test_a_keypoint_is_the_place_of_its_colour_and_whether_it_is_there() -> None:
    image = belief_model()["belief"].history.image
    image.palette[3] = torch.tensor([255.0, 0.0, 0.0])
    image.palette[5] = torch.tensor([0.0, 240.0, 0.0])
    rgb = torch.full((3, *IMAGE), 128, dtype=torch.uint8)
    rgb[0, 5, 10] = rgb[1, 30, 21] = torch.tensor([255, 0, 0], dtype=torch.uint8)
    rgb[:, 8, 9] = torch.tensor([0, 240 + 16, 0]).clamp(max=255).to(torch.uint8)  # nearly that green
    keypoints = image(rgb, mask=0.9)[2].unflatten(1, (16, 3))  # keypoints see what is masked, too
    red, green = keypoints[:, 3], keypoints[:, 5]
    assert torch.allclose(red[:2, :2], torch.tensor([[5.0, 10], [30, 21]]) / 35 * 2 - 1, atol=1e-3)
    assert torch.allclose(green[:, :2], torch.tensor([8.0, 9]) / 35 * 2 - 1, atol=1e-3)
    assert red[:2, 2].min() > 0.999 and red[2, 2] < 1e-9 and torch.allclose(red[2, :2], torch.zeros(2), atol=1e-3)
    assert torch.allclose(green[:, 2], torch.tensor(-((15 / 16) ** 2) / 2).exp())


def test_patches_show_how_much_there_is_of_each_colour() -> None:
    image, seen = aib_belief.ImageEncoder([128, 192, 3]), []
    assert (image.every, image.patch) == (2, 8), "4 x 4 of a patch's pixels"
    image.palette[7] = torch.tensor([100.0, 50.0, 0.0])
    rgb = torch.full((1, 128, 192, 3), 255, dtype=torch.uint8)
    rgb[0, 16:20, 40:46] = torch.tensor([100, 50, 0], dtype=torch.uint8)  # 2 x 3 of these
    image.token.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][..., -16:]))
    image(rgb)
    assert seen[0].shape == (1, 16 * 24, 16)
    assert torch.allclose(seen[0][0, 2 * 24 + 5, 7], torch.tensor(10 * 6 / 16)) and seen[0][0, 0, 7] < 1e-9


def test_a_palette_has_the_colours_that_differ_most() -> None:
    colours = torch.tensor([[200.0, 0, 0]] * 90 + [[0, 0, 90.0]] * 9 + [[0, 90.0, 0]])
    colours = torch.cat([colours, colours[:90] - torch.rand(90, 3)])
    palette = aib_belief.spread_colours(colours)
    assert palette.shape == (16, 3)
    assert sorted(palette[:2].tolist()) == [[0, 0, 90], [0, 90, 0]] and palette[2, 0] > 198
    assert all((colours == colour).all(-1).any() for colour in palette)


def test_the_palette_is_of_the_training_episodes(toy_stages: Path) -> None:
    rgb = np.load(toy_stages / f"{TOY}__aib_repr__1" / "dataset" / "rgb.npy")[:16].reshape(-1, 3)
    belief = torch.load(toy_stages / f"{TOY}__aib_belief__1" / "belief.pt", weights_only=True)["belief"]
    palette = belief["history.image.palette"]
    assert all((rgb == colour.numpy()).all(-1).any() for colour in palette) and len(palette.unique(dim=0)) > 3


def test_a_place_is_kept_while_the_attention_is_not_sure() -> None:
    history, before, found = belief_model()["belief"].history, torch.zeros(2, 10), torch.ones(2, 10)
    weights = torch.tensor([[0.9, 0.05, 0.05], [0.05, 0.05, 0.05]])
    kept = history.keep(found, weights, before)
    assert kept[0].min() > 0.99 and kept[1].max() < 0.05


def test_masks_hide_blocks_of_two_by_two_pixels() -> None:
    history = aib_belief.HistoryEncoder({**CONFIG, "image_shape": [37, 45, 3]})
    rgb = torch.randint(0, 256, (40, 37, 45, 3), dtype=torch.uint8)
    history.image.mean = torch.full((37, 45, 3), 3.5)
    seen = []
    history.image.token.register_forward_pre_hook(
        lambda _, inputs: seen.append(inputs[0][..., :12].unflatten(2, (3, 4)))
    )
    plain, again, masked = history.image(rgb), history.image(rgb), history.image(rgb, 0.75)
    assert torch.equal(plain[0], again[0]) and not torch.equal(plain[0], masked[0])
    hidden = (seen[2] == 0).flatten(2).all(-1)
    assert 0.72 < hidden.float().mean() < 0.78 and torch.equal(seen[2][~hidden], seen[0][~hidden])
    assert hidden.float().mean(0).min() > 0.4, "not the same blocks in all pictures"


def test_the_warmup_loss_is_the_closed_form() -> None:
    model = belief_model()
    model["teacher"].train()
    batch = {"rgb": belief_batch()["rgb"][0], "u": torch.randn(B, 4), "u_0": torch.randn(B, 4)}
    batch["t"] = torch.arange(B) + 1
    torch.manual_seed(3)
    loss = aib_belief.warmup_loss(model, batch, losses_args())
    history, belief = model["belief"].history, model["belief"]
    u_0 = batch["u_0"]
    standard = (u_0 - u_0.mean(0)) / (u_0.var(0, correction=0) + 0.05**2).sqrt()
    memory = model["teacher"].net(torch.cat([standard, (batch["t"] + 1).log()[:, None]], -1))
    memory = torch.cat([memory, torch.zeros(B, 16)], -1)
    keys, contents, _ = history.image(batch["rgb"])
    place, _ = history.ask(memory, keys, contents)
    embedded = history.place(torch.cat([place, torch.zeros(B, 48)], -1))
    torch.manual_seed(3)
    errors = []
    for seen_memory in (memory, 0 * memory):
        h = history.out(torch.cat([seen_memory, embedded], -1)) + history.arm.bias
        p = belief.prior(h)
        decoded = belief.decoder(torch.cat([p.mean + p.stddev * torch.randn(B, 1, 5)[:, 0], h], -1))
        errors.append((decoded.mean - batch["u"]).square().sum(-1).mean())
    assert torch.allclose(loss, sum(errors) / 2, atol=1e-4)
    loss.backward()
    for learns in (history.image.token[0][0].weight, history.query[0].weight, model["teacher"].net[0].weight):
        assert learns.grad.abs().sum() > 0
    assert history.gru.weight_hh.grad is None


@pytest.mark.parametrize("script", [aib_belief, ppo_believer])
def test_beside_the_elbo_the_prior_and_the_memory_are_trained(script: ModuleType) -> None:
    model, batch = belief_model(), belief_batch()
    if script is ppo_believer:
        model["belief"] = ppo_believer.BelieverBelief(CONFIG)
    method = script.believer_losses if script is ppo_believer else script.belief_losses
    losses = method(model, batch, losses_args(warmup_updates=5, prior_nll=0.5))
    total = losses["nll"] + losses["kl"] + losses.get("action", 0) + 0.5 * losses["prior_nll"] + 10 * losses["memory"]
    assert torch.allclose(losses["total"], total)
    wanted = torch.stack([model["teacher"](batch["u"][0], torch.full((B,), t)) for t in range(T + 1)])
    h, memory = script.encode_history(model["belief"].history, batch)
    assert torch.allclose(losses["memory"], (memory[..., :16] - wanted).square().sum(-1).mean(), atol=1e-4)
    grads = torch.autograd.grad(losses["memory"], list(model["teacher"].parameters()), allow_unused=True)
    assert all(grad is None for grad in grads), "the teacher does not follow"
    torch.manual_seed(4)
    loss = script.prior_nll_loss(model["belief"], batch["u"], h)
    torch.manual_seed(4)
    z = torch.randn(T + 1, B, 1, 5)[:, :, 0]
    if script is aib_belief:
        p = model["belief"].prior(h)
        z = p.mean + p.stddev * z
    decoded = model["belief"].decoder(torch.cat([z, h], -1))
    assert torch.allclose(loss, -decoded.log_prob(batch["u"]).sum(-1).mean(), atol=1e-4)


def test_joints_enter_the_history_standardised() -> None:
    history, batch = belief_model()["belief"].history, belief_batch()
    plain, _ = aib_belief.encode_history(history, batch)
    history.joints_mean.fill_(3.0)
    history.joints_std.fill_(2.0)
    assert not torch.allclose(aib_belief.encode_history(history, batch)[0], plain, atol=1e-3)
    batch["joints"] = batch["joints"] * 2 + 3
    assert torch.allclose(aib_belief.encode_history(history, batch)[0], plain, atol=1e-5)


def test_chrono_initialisation_sets_the_update_gate() -> None:
    gru = nn.GRUCell(8, 64)
    aib_belief.chrono_init(gru, 60)
    bias = gru.bias_ih[64:128] + gru.bias_hh[64:128]
    assert bias.min() >= 0 and bias.max() <= math.log(59) and bias.std() > 0.3
    # with all weights 0 the update gate alone decides what is kept: sigmoid(bias), so about 1 / (1 - gate) steps
    for name, parameter in gru.named_parameters():
        if "weight" in name:
            nn.init.zeros_(parameter)
    assert gru(torch.zeros(1, 8), torch.ones(1, 64)).mean() > 0.85


def test_the_belief_starts_from_the_training_episodes_mean_image_and_joints(toy_stages: Path) -> None:
    rgb = np.load(toy_stages / f"{TOY}__aib_repr__1" / "dataset" / "rgb.npy")[:16, ::8].astype(float)
    history = torch.load(toy_stages / f"{TOY}__aib_belief__1" / "belief.pt", weights_only=True)["belief"]
    assert torch.allclose(history["history.image.mean"].double(), torch.from_numpy(rgb.mean((0, 1))), atol=1e-3)
    assert abs(history["history.image.std"].item() - (rgb - rgb.mean((0, 1))).std()) < 1e-3
    joints = torch.from_numpy(np.load(toy_stages / f"{TOY}__aib_repr__1" / "dataset" / "joints.npy")[:16]).flatten(0, 1)
    assert torch.allclose(history["history.joints_mean"], joints.mean(0), atol=1e-4)
    assert torch.allclose(history["history.joints_std"], joints.std(0, correction=0), atol=1e-4)
    gate = history["history.gru.bias_ih"][256:512]
    assert gate.min() > -0.1 and 1 < gate.max() < math.log(9) + 0.1, "chrono_init, and three updates"
    model = torch.load(toy_stages / f"{TOY}__aib_repr__1" / "checkpoint.pt", weights_only=True)["model"]
    dataset = toy_stages / f"{TOY}__aib_repr__1" / "dataset"
    rewards, state = (torch.from_numpy(np.load(dataset / f"{name}.npy")[:16]) for name in ("rewards", "state"))
    assert torch.allclose(model["g.reward_mean"], rewards.mean(), atol=1e-5)
    assert torch.allclose(model["g.reward_std"], rewards.std(correction=0), atol=1e-5)
    assert torch.allclose(model["phi.mean"], state.mean((0, 1)), atol=1e-5)
    assert torch.allclose(model["phi.std"], state.std((0, 1), correction=0).clip(0.05), atol=1e-5)


def test_both_image_encoders_subtract_the_mean_image_and_start_orthogonal() -> None:
    psi, history = aib_repr.ObservationEncoder(tuple(IMAGE), 7, 4), aib_belief.HistoryEncoder(CONFIG)
    history.image.palette.fill_(1000.0)  # colours as such are in no picture
    rgb, joints = torch.randint(0, 100, (2, *IMAGE), dtype=torch.uint8), torch.randn(2, 7)
    for encoder, names, encode, layer in (
        (psi, ["image_mean", "image_std"], lambda x: psi(x, joints).mean, psi.cnn.out[0]),
        (history.image, ["mean", "std"], lambda x: history(x, joints)[0], history.image.token[0][0]),
    ):
        plain = encode(rgb)
        setattr(encoder, names[0], torch.full(IMAGE, 50.0))
        setattr(encoder, names[1], torch.tensor(510.0))
        assert not torch.allclose(encode(rgb), plain, atol=1e-4)
        assert torch.allclose(encode(2 * rgb + 50), plain, atol=1e-5)
        weight = layer.weight
        gram = weight.T @ weight if len(weight) > weight.shape[1] else weight @ weight.T
        assert torch.allclose(gram, 2 * torch.eye(len(gram)), atol=1e-4)


def test_state_and_joints_are_standardised_in_phi_and_psi() -> None:
    phi, psi = aib_repr.StateEncoder(5, 4), aib_repr.ObservationEncoder(tuple(IMAGE), 7, 4)
    state, joints = torch.randn(B, 5), torch.randn(B, 7)
    rgb = torch.randint(0, 256, (B, *IMAGE), dtype=torch.uint8)
    plain, plain_joints = phi(state).mean, psi(rgb, joints).mean
    phi.mean.fill_(3.0), phi.std.fill_(2.0), psi.joints_mean.fill_(3.0), psi.joints_std.fill_(2.0)
    assert torch.allclose(phi(2 * state + 3).mean, plain, atol=1e-5)
    assert torch.allclose(psi(rgb, 2 * joints + 3).mean, plain_joints, atol=1e-5)
    gaussian = aib_repr.GaussianMLP(5, [8], 4, min_std=0.1)
    nn.init.constant_(gaussian.net[-1].bias, -100.0)
    assert torch.allclose(gaussian(state).stddev, torch.tensor(0.1))


def test_readout_score_on_features_of_known_content() -> None:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(3000, 200, generator=generator)
    signal, noise = x[:, :2], torch.randn(3000, 2, generator=generator)

    def score(y: torch.Tensor, features: torch.Tensor = x, count: int = 2000) -> float:
        fit, test = slice(0, count), slice(2000, 3000)
        return probes.probe_score(features[fit], y[fit], features[test], y[test])

    assert score((x[:, :1] > 0).float() * 3, x[:, :6]) > 0.95, "two colours"
    assert score(torch.bucketize(x[:, :1], torch.tensor([-0.5, 0.5])).float(), x[:, :1]) > 0.9, "three on a line"
    assert 0.75 < score(signal + 0.5 * noise) < 0.82, "true R2: 0.8"
    assert -0.1 < score(noise, count=210) < 0.1, "as many episodes as features: without a good ridge far below 0"
    constant = torch.ones(3000, 1)
    assert score(torch.cat([signal, constant], 1)) == pytest.approx(score(signal)), "what never varies does not count"
    hardly = 0.01 * noise[:, :1]
    assert score(torch.cat([signal, hardly], 1)) > 0.99 > score(hardly) + 0.9, "nor what hardly varies"


def test_report_of_a_belief_that_knows_and_of_its_chance() -> None:
    torch.manual_seed(0)
    velocity, colour = torch.randn(40, 3), torch.randint(0, 4, (40, 1)).float()
    velocity[:, 2] = 0  # the ball stays on the table
    for cue, chance in ((velocity, 0.0), (colour, 0.25), (torch.cat([colour, colour > 1], 1), (0.25 + 0.5) / 2)):
        u = cue[:, None].expand(-1, T + 1, -1).clone()
        known = torch.nn.functional.one_hot(colour[:, 0].long(), 4)[:, None].float().expand(-1, T + 1, -1)
        seen = {"u": u, "u_prior": u + 0.1, "u_posterior": u, "h": torch.cat([u, known], -1), "cue": cue}
        seen |= {"nll_prior": torch.ones(40, T + 1), "nll_posterior": torch.zeros(40, T + 1)}
        seen |= {"z_mean": torch.randn(40, T + 1, 5), "actions": torch.rand(40, T, A)}
        seen["z_mean"][:, 1:, :A] = seen["actions"]
        seen["u_prior"][:, -1] = torch.randn_like(u[:, -1])
        report = probes.probe_belief(*({name: x[part] for name, x in seen.items()} for part in (SELECT, REPORT)))
        assert report["cue_chance"] == pytest.approx(chance)
        assert (report["nll_prior"], report["nll_posterior"]) == (1, 0)
        assert report["cue_from_particle"][-1] < 0.8 < 0.95 < report["cue_from_u"][-1]
        assert report["action_readout"] > 0.9, "a_t from z_t and z_t+1"
        assert min(report["cue_from_h"]) > 0.95 and min(report["u_r2_posterior"]) == 1
        left = 0.01 * cue[REPORT].numel() / (cue[REPORT] - cue[REPORT].mean(0)).square().sum()
        assert report["u_r2_prior"][0] == pytest.approx(1 - left.item(), abs=1e-5)


def test_flow_gain_tells_a_live_head_from_a_dead_one() -> None:
    torch.manual_seed(0)
    action = torch.rand(8, T, A) * 2 - 1
    q = torch.zeros(8, T + 1, 5)
    q[:, 1:, :A] = action  # z_t+1 names the action, so that a_1 - a_0 = (a_1 - a_tau) / (1 - tau) is known

    def live(x: torch.Tensor) -> torch.Tensor:
        a_tau, tau, z_next = x[..., :A], x[..., A : A + 1], x[..., A + 1 + 5 :]
        return (z_next[..., :A] - a_tau) / (1 - tau).clamp(min=1e-3)

    loss, gain = probes.flow_gain(live, q, action)
    assert loss < 1e-4 and gain > 0.5
    loss, gain = probes.flow_gain(lambda x: torch.zeros_like(x[..., :A]), q, action)
    assert loss > 1 and gain == 0


# ---------------------------------------------------------------- stage 3


def test_gae_is_the_double_sum() -> None:
    rewards, values, gamma, lam = torch.randn(9, B), torch.randn(10, B), 0.95, 0.9
    advantages = ppo_aib.compute_gae(rewards, values, gamma, lam)
    for t in range(9):
        direct = torch.zeros(B)
        for k in range(t, 9):
            delta = rewards[k] + gamma * values[k + 1] - values[k]
            direct += (gamma * lam) ** (k - t) * delta
        assert torch.allclose(advantages[t], direct, atol=1e-5)


def test_belief_aggregator_is_the_papers_formula() -> None:
    torch.manual_seed(0)
    agent = ppo_aib.Agent(spaces(IMAGE, 7, A), ppo_aib.AIBBelief(CONFIG), ppo_aib.Args())
    obs = {"rgb": torch.randint(0, 256, (B, *IMAGE), dtype=torch.uint8), "joints": torch.randn(B, 7)}
    particles = torch.randn(B, 30, 4)
    nn.init.orthogonal_(agent.actor[-1].weight, 3.0)  # else too near 0 to tell tanh from nothing
    policy, value = agent({**obs, "particles": particles})
    assert policy.mean.shape == (B, A) and value.shape == (B,)
    belief = agent.w_agg(torch.stack([agent.w_enc(particles[:, i]) for i in range(30)]).mean(0))
    image, joints = agent.cnn(obs["rgb"].float() / 255), agent.joints(obs["joints"])
    x = torch.cat([image, joints, belief], -1)
    assert torch.allclose(policy.mean, torch.tanh(agent.actor(x)), atol=1e-6)
    assert torch.allclose(value, agent.critic(x)[:, 0], atol=1e-6)
    plain = ppo_baseline.Agent(spaces(IMAGE, 7, A), ppo_baseline.Args())
    nn.init.orthogonal_(plain.actor[-1].weight, 3.0)
    x = torch.cat([plain.cnn(obs["rgb"].float() / 255), plain.joints(obs["joints"])], -1)
    assert torch.allclose(plain(obs)[0].mean, torch.tanh(plain.actor(x)), atol=1e-6)


def test_success_once_and_at_end() -> None:
    success = torch.tensor([[0.0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 1, 0]])  # in 3 of 4 episodes once, at the end in 1
    metrics = ppo_aib.success_and_return({"success": success, "rewards": torch.full((3, 4), 0.5)})
    assert metrics == {"success_once": 0.75, "success_at_end": 0.25, "return": 1.5}


def test_ppo_losses_are_the_closed_forms() -> None:
    args = SimpleNamespace(clip_coef=0.2, ent_coef=0.01, vf_coef=0.5)
    mean, log_std = torch.randn(64, A), torch.full((A,), -0.5)
    policy, value = Normal(mean, log_std.exp().expand(64, A)), torch.randn(64)
    batch = {"actions": policy.sample(), "advantages": torch.randn(64), "returns": torch.randn(64)}
    batch["logprobs"] = policy.log_prob(batch["actions"]).sum(-1) + 0.3 * torch.randn(64)
    losses = ppo_aib.ppo_losses(lambda _: (policy, value), batch, args)
    ratio = (policy.log_prob(batch["actions"]).sum(-1) - batch["logprobs"]).exp()
    a = (batch["advantages"] - batch["advantages"].mean()) / (batch["advantages"].std(correction=0) + 1e-8)
    surrogate = torch.where(a >= 0, ratio.clamp(max=1.2) * a, ratio.clamp(min=0.8) * a)
    assert torch.allclose(losses["policy_loss"], -surrogate.mean(), atol=1e-6)
    assert torch.allclose(losses["value_loss"], 0.5 * ((value - batch["returns"]) ** 2).mean())
    entropy = A * (-0.5 + 0.5 * math.log(2 * math.pi * math.e))
    assert abs(losses["entropy"].item() - entropy) < 1e-4
    total = losses["policy_loss"] - 0.01 * losses["entropy"] + 0.5 * losses["value_loss"]
    assert torch.allclose(losses["total"], total)
    one = {name: x[:1] for name, x in batch.items()}  # a minibatch of one step, as --num-envs 1 may leave
    assert ppo_aib.ppo_losses(lambda _: (Normal(mean[:1], 1.0), value[:1]), one, args)["total"].isfinite()


def test_objects_are_hidden_until_the_end() -> None:
    model, batch = belief_model(), belief_batch()
    history, episodes = model["belief"].history, 40
    batch = {"rgb": torch.full((20, episodes, *IMAGE), 7, dtype=torch.uint8), "u": torch.randn(20, episodes, 4)}
    place = torch.zeros(1, 10)
    place[:, :2] = torch.tensor([0.0, 0.5])  # in the middle of the rows, at three quarters of the columns
    history.ask = lambda memory, keys, contents: (place.expand(len(memory), -1), None)
    aib_belief.hide_objects(model, batch, 0.5, np.random.default_rng(0))
    hidden = (batch["rgb"] != 7).any(-1)
    assert 10 < hidden.any((0, 2, 3)).sum() < 30, "half of the episodes"
    for episode in range(episodes):
        seen = hidden[:, episode]
        steps = seen.flatten(1).any(1).nonzero().flatten().tolist()
        if steps:
            assert steps == list(range(steps[0], 20)) and torch.equal(seen[steps[0]], seen[-1])
            rows, columns = seen[-1].any(1), seen[-1].any(0)
            assert 8 <= rows.sum() < 18 and 8 <= columns.sum() < 18 and rows[18] and columns[27]
            assert torch.equal(seen[-1], rows[:, None] & columns), "a rectangle"
            assert len(batch["rgb"][-1, episode][seen[-1]].unique(dim=0)) == 1, "of one colour"
