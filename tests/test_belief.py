"""Stage 2 as a whole: what it costs, and that it is the same computation as the slow way."""

import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import aib_belief
import aib_repr
import ppo_aib
import ppo_believer
from conftest import ROOT, SCRIPTS, TOY, train

sys.path.append(str(ROOT / "benchmark"))
import belief as probes  # noqa: E402


def make_stage_1(folder: Path, episodes: int) -> int:
    """Write a stage 1 of random numbers with 128 x 128 images; the bytes of its images."""
    path = folder / "runs" / f"{TOY}__aib_repr__1"
    (path / "dataset").mkdir(parents=True)
    rng = np.random.default_rng(0)
    rgb = np.lib.format.open_memmap(path / "dataset" / "rgb.npy", "w+", np.uint8, (episodes, 11, 128, 128, 3))
    for episode in range(episodes):
        rgb[episode] = rng.integers(0, 256, rgb.shape[1:], dtype=np.uint8)
    arrays = {"state": rng.normal(size=(episodes, 11, 4)), "joints": rng.normal(size=(episodes, 11, 3))}
    arrays |= {"actions": rng.uniform(-1, 1, (episodes, 10, 2)), "cue": rng.integers(3, size=(episodes, 1))}
    for name, array in arrays.items():
        np.save(path / "dataset" / f"{name}.npy", array.astype(np.float32))
    content = {"env_id": TOY, "robot_triangles": 500, "image_size": 128, "num_val": 8}
    phi, psi = aib_repr.StateEncoder(4, 4), aib_repr.ObservationEncoder([128, 128, 3], 3, 4)
    content |= {"u_dim": 4, "phi": phi.state_dict(), "norm": dict(psi.named_buffers())}
    aib_repr.save(path / "repr.pt", content)
    return rgb.nbytes


def test_peak_memory_does_not_grow_with_the_number_of_episodes(tmp_path: Path) -> None:
    peaks, sizes = [], []
    for episodes in (560, 1600):
        folder = tmp_path / str(episodes)
        sizes.append(make_stage_1(folder, episodes))
        code = "import sys, aib_belief as b; b.main(b.Args(env_id=sys.argv[1], num_updates=3, batch_episodes=4))"
        # not ru_maxrss: a child inherits its parent's
        code += "; print('PEAK', open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run([sys.executable, "-c", code, TOY], cwd=folder, env=env, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        peaks.append(1024 * int(done.stdout.split("PEAK")[1]))
    print("images and peak memory in MB:", *(round(x / 1e6) for x in sizes + peaks))
    assert peaks[1] - peaks[0] < 0.25 * (sizes[1] - sizes[0])


def test_the_last_episodes_are_held_out_and_the_last_weights_kept(
    toy_task: Path, toy_stages: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks, validated, validate_belief = [], [], aib_belief.validate_belief
    read = note_episodes(monkeypatch, aib_belief)

    def recorded(belief: torch.nn.Module, episodes: object, index: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        looks.append((index.tolist(), {name: x.clone() for name, x in belief.state_dict().items()}))
        validated.append(validate_belief(belief, episodes, index))
        return validated[-1]

    monkeypatch.setattr(aib_belief, "validate_belief", recorded)
    monkeypatch.setattr(aib_belief, "VAL_EVERY", 2)
    repr_dir = str(toy_stages / f"{TOY}__aib_repr__1")
    path = train(aib_belief, repr_dir=repr_dir, num_updates=6, batch_episodes=5)
    held_out = [16, 17, 18, 19]  # of 20 episodes
    trained = [index for index in read if len(index) == 5]
    assert len(trained) == 6 and max(map(max, trained)) < 16
    assert [episodes for episodes, _ in looks] == [held_out] * 4
    stored = torch.load(path / "belief.pt", weights_only=True)
    phi = torch.load(Path(repr_dir) / "repr.pt", weights_only=True)["phi"]
    state = torch.from_numpy(np.load(Path(repr_dir) / "dataset" / "state.npy")[held_out])
    encoder = aib_belief.StateEncoder(4, 16)
    encoder.load_state_dict(phi)
    u, estimate = validated[-1]
    assert torch.allclose(u, encoder(state).mean.transpose(0, 1), atol=1e-6), "the mean of phi(s)"
    events = EventAccumulator(str(path)).Reload().Scalars("belief/held_out_u_r2_by_step")
    assert [event.step for event in events] == list(range(11))
    assert events[-1].value == pytest.approx(aib_belief.r_squared(u[-1], estimate[-1]))
    stored = stored["belief"]
    assert all(torch.equal(stored[name], x) for name, x in looks[2][1].items())  # the last weights
    assert any((stored[name] != x).any() for name, x in looks[1][1].items())


def note_episodes(monkeypatch: pytest.MonkeyPatch, module: ModuleType) -> list[list[int]]:
    """The episodes that a script's EpisodeDataset is asked for, call by call."""
    read, call = [], module.EpisodeDataset.__call__
    monkeypatch.setattr(module.EpisodeDataset, "__call__", lambda self, x: read.append(x.tolist()) or call(self, x))
    return read


def test_believers_belief_gets_the_episodes_phi_and_statistics_of_aibs(
    toy_task: Path, toy_stages: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, repr_dir = note_episodes(monkeypatch, ppo_believer), toy_stages / f"{TOY}__aib_repr__1"
    sizes = dict(num_updates=3, batch_episodes=4, num_envs=4, total_timesteps=40, num_minibatches=2)
    path = train(ppo_believer, repr_dir=str(repr_dir), num_eval_episodes=2, **sizes)
    trained = [index for index in read if len(index) == 4 and 16 not in index]
    assert len(trained) == 3 and max(map(max, trained)) < 16
    assert [index for index in read if 16 in index] == [[16, 17, 18, 19]] * 2
    belief = torch.load(path / "belief.pt", weights_only=True)["belief"]
    stage_1 = torch.load(repr_dir / "repr.pt", weights_only=True)
    for name, x in stage_1["norm"].items():
        assert torch.equal(belief[f"history.{name.replace('image_', 'image.')}"], x)


@pytest.mark.parametrize("warmup_updates", [2, 0])
@pytest.mark.parametrize("script", ["aib_belief", "ppo_believer"])
def test_warm_up_then_whole_episodes(
    toy_task: Path, toy_stages: Path, monkeypatch: pytest.MonkeyPatch, script: str, warmup_updates: int
) -> None:
    module, rates, order, step = SCRIPTS[script], [], [], torch.optim.Adam.step
    fresh = []

    def noted_step(self: torch.optim.Adam) -> None:
        rates.append(self.param_groups[0]["lr"])
        fresh.append(not self.state)
        step(self)

    monkeypatch.setattr(torch.optim.Adam, "step", noted_step)
    warmup_loss, encode_history = module.warmup_loss, module.encode_history

    def noted_warmup(model: torch.nn.ModuleDict, frames: dict, args: object) -> torch.Tensor:
        assert frames["rgb"].shape == (32, 36, 36, 3) and model["teacher"].training
        assert all(parameter.requires_grad for parameter in model.parameters())
        order.append("warm-up")
        return warmup_loss(model, frames, args)

    def noted_history(history: torch.nn.Module, batch: dict, *options: object) -> tuple:
        if options:  # not a validation
            order.append("episodes")
            learning = {name.split(".")[0] for name, x in history.named_parameters() if x.requires_grad}
            assert ("image" in learning) is (not warmup_updates) and "gru" in learning
        return encode_history(history, batch, *options)

    monkeypatch.setattr(module, "warmup_loss", noted_warmup)
    monkeypatch.setattr(module, "encode_history", noted_history)
    hide_objects = module.hide_objects
    monkeypatch.setattr(module, "hide_objects", lambda *arguments: (order.append("hide"), hide_objects(*arguments)))
    sizes = dict(warmup_updates=warmup_updates, num_updates=4, batch_episodes=4, belief_lr=1e-3)
    if script == "ppo_believer":
        sizes |= dict(num_envs=4, total_timesteps=40, num_minibatches=2, num_eval_episodes=2)
    train(module, repr_dir=str(toy_stages / f"{TOY}__aib_repr__1"), **sizes)
    if not warmup_updates:
        assert order == ["episodes"] * 4, "an untrained teacher hides nothing"
        return
    assert order == ["warm-up"] * 2 + ["hide", "episodes"] * 4
    assert rates[:6] == pytest.approx([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 5e-4]), "falls over the second half"
    assert fresh[:6] == [True, False, True, False, False, False], "Adam starts anew after the warm-up"


@pytest.mark.parametrize(
    "variant",
    [
        dict(action_head="mse", warmup_updates=1, prior_nll=1.0),
        dict(action_head="none", image_mask=0.0),
    ],
)
def test_ablations_train(toy_task: Path, toy_stages: Path, variant: dict) -> None:
    repr_dir = str(toy_stages / f"{TOY}__aib_repr__1")
    path = train(aib_belief, repr_dir=repr_dir, num_updates=1, batch_episodes=4, **variant)
    probes.main(probes.Args(path))
    report = json.loads((path / "diagnostics.json").read_text())
    assert len(report["u_r2_prior"]) == 11 and "flow_gain" not in report


def test_earlier_stages_get_what_they_need_to_know(
    toy_task: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    commands, status = [], 0
    monkeypatch.setattr(subprocess, "Popen", lambda x: commands.append(x) or SimpleNamespace(wait=lambda: status))
    same = dict(env_id="RememberColor3-v0", seed=3, small=True)
    simulator = dict(robot_triangles=0, image_size=40, num_workers=5)
    for module, scripts in ((ppo_aib, (aib_repr, aib_belief)),):
        with pytest.raises(SystemExit):  # as the command, which does nothing here, leaves no file
            module.main(module.Args(**same, **simulator, exp_name="test", num_minibatches=1))
        for earlier in scripts:
            monkeypatch.setattr(sys, "argv", commands.pop(0)[1:])
            args = earlier.parse_args()
            expected = same if earlier is aib_belief else same | simulator
            assert expected.items() <= asdict(args).items() and args.exp_name == f"{earlier.__name__}_small"
    assert not commands
    capsys.readouterr()
    status = -9
    with pytest.raises(SystemExit):
        ppo_aib.run_stage("aib_repr.py", ppo_aib.Args(), [])
    assert "aib_repr.py was killed by signal 9" in capsys.readouterr().err


@pytest.mark.parametrize("script", ["aib_belief", "ppo_believer"])
def test_everything_learns_with_clipped_gradients_and_floors_of_the_deviations(
    toy_task: Path, toy_stages: Path, monkeypatch: pytest.MonkeyPatch, script: str
) -> None:
    module, norms, floors = SCRIPTS[script], [], []
    clip, init = torch.nn.utils.clip_grad_norm_, module.GaussianMLP.__init__

    def noted_clip(parameters: object, max_norm: float, **options: object) -> torch.Tensor:
        norms.append(max_norm)
        return clip(parameters, max_norm, **options)

    def noted_init(self: torch.nn.Module, inputs: int, hidden: list[int], size: int, min_std: float) -> None:
        floors.append(min_std)
        init(self, inputs, hidden, size, min_std)

    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", noted_clip)
    monkeypatch.setattr(module.GaussianMLP, "__init__", noted_init)
    sizes = dict(warmup_updates=1, num_updates=1, batch_episodes=4)
    if script == "ppo_believer":
        sizes |= dict(num_envs=4, total_timesteps=40, num_minibatches=1, update_epochs=1, num_eval_episodes=2)
    models = []
    for rate in (0.0, 1e-3):
        options = dict(repr_dir=str(toy_stages / f"{TOY}__aib_repr__1"), exp_name=f"rate_{rate}", belief_lr=rate)
        path = train(module, **options, **sizes)
        file = "checkpoint.pt" if script == "aib_belief" else "belief_checkpoint.pt"
        models.append(torch.load(path / file, weights_only=True)["model"])
    assert norms[:2] == [10.0, 10.0] and set(floors) == {0.1, 1e-5}, "1e-5 for phi alone"
    parts = ["belief.history.gru.weight_ih", "belief.decoder.net.0.weight", "posterior.net.0.weight"]
    parts += ["teacher.net.0.weight"]
    if script == "aib_belief":
        parts += ["belief.prior.net.0.weight", "head.0.weight"]
    for part in parts:
        assert not torch.equal(models[0][part], models[1][part]), part
