"""Stage 3 and the baselines on the toy task: what an iteration is made of, and that it depends on nothing else."""

import csv
import shutil
import sys
import weakref
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import aib_belief
import ppo_aib
import ppo_baseline
import ppo_believer
import toy
from conftest import ROOT, SCRIPTS, TOY, train

sys.path.append(str(ROOT / "benchmark"))
import diagnose_agent  # noqa: E402

METHODS = ["ppo_aib", "ppo_believer", "ppo_baseline"]
SMALL = dict(total_timesteps=160, num_envs=8, num_minibatches=4, eval_every=1, num_eval_episodes=6, num_workers=3)


def small(module: ModuleType, toy_stages: Path, **changes: object) -> dict:
    """Arguments of a small run of a method on the toy stages of conftest."""
    more = {}
    if module is ppo_aib:
        more = dict(belief=str(toy_stages / f"{TOY}__aib_belief__1" / "belief.pt"))
    elif module is ppo_believer:
        more = dict(repr_dir=str(toy_stages / f"{TOY}__aib_repr__1"))
        more |= dict(num_updates=3, batch_episodes=4)
    return {**SMALL, **more, **changes}


def play(toy_stages: Path, **changes: object) -> tuple[ppo_aib.Agent, dict[str, torch.Tensor]]:
    """An AIB agent and what it played in one iteration of the toy task."""
    args = ppo_aib.Args(env_id=TOY, **small(ppo_aib, toy_stages, **changes))
    stored = torch.load(args.belief, weights_only=True)
    torch.manual_seed(0)
    agent = ppo_aib.Agent(toy.ToyMemory(1), ppo_aib.AIBBelief(stored["config"]), args)
    agent.belief.load_state_dict(stored["belief"])
    torch.manual_seed(1)
    return agent, ppo_aib.rollout(toy.make_envs(args), agent, args, np.arange(8))


def test_rollout_arrays(toy_stages: Path) -> None:
    _, data = play(toy_stages)
    assert {name: (tuple(x.shape), x.dtype) for name, x in data.items()} == {
        "rgb": ((10, 8, 36, 36, 3), torch.uint8),
        "joints": ((10, 8, 3), torch.float32),
        "particles": ((10, 8, 30, 16), torch.float32),
        "actions": ((10, 8, 2), torch.float32),
        "logprobs": ((10, 8), torch.float32),
        "values": ((11, 8), torch.float32),
        "rewards": ((10, 8), torch.float32),
        "success": ((10, 8), torch.float32),
    }


def test_particles_are_draws_from_prior_and_decoder(toy_stages: Path) -> None:
    agent, data = play(toy_stages)
    torch.manual_seed(1)  # as play does before the rollout
    z_noise, u_noise = torch.randn(11, 8, 30, 32), torch.randn(11, 8, 30, 16)
    h, _ = aib_belief.encode_history(agent.belief.history, data)
    p = agent.belief.prior(h)
    for i in (0, 29):
        d = agent.belief.decoder(torch.cat([p.mean + p.stddev * z_noise[:10, :, i], h], -1))
        assert torch.allclose(data["particles"][:, :, i], d.mean + d.stddev * u_noise[:10, :, i], atol=1e-4)


def test_the_ratio_starts_at_one_because_the_particles_are_kept(toy_stages: Path) -> None:
    agent, data = play(toy_stages)
    batch = {name: x[:10].flatten(0, 1) for name, x in data.items()}

    def ratio(particles: torch.Tensor) -> torch.Tensor:
        policy, _ = agent({**batch, "particles": particles})
        return (policy.log_prob(batch["actions"]).sum(-1) - batch["logprobs"]).exp()

    assert torch.allclose(ratio(batch["particles"]), torch.ones(80), atol=1e-5)
    h, _ = aib_belief.encode_history(agent.belief.history, data)
    decoded = agent.belief.decode(h, torch.randn(10, 8, 30, 32))
    fresh = (decoded.mean + decoded.stddev * torch.randn(10, 8, 30, 16)).flatten(0, 1)
    assert (ratio(fresh) - 1).abs().max() > 1e-4, "fresh draws would not do"


def test_particle_noise_is_the_decoders(toy_stages: Path) -> None:
    particles = play(toy_stages)[1]["particles"][0]
    assert particles.std(1).mean() > 0.5, "the decoder's std is still about softplus(0) + 0.1, that of its means 0.1"


def test_u_r2_tells_what_the_belief_knows_of_the_episodes_just_played(toy_stages: Path) -> None:
    """Particles that are u but for known noise; states are recorded as a rollout plays three episodes at a time."""
    agent, _ = play(toy_stages)
    args = ppo_aib.Args(env_id=TOY, **small(ppo_aib, toy_stages))
    diagnose_agent.RecordState.rounds.clear()
    envs = diagnose_agent.RecordState(toy.make_envs(args))
    seeds = np.arange(16)
    buffer = ppo_aib.rollout(envs, agent, args, seeds, deterministic=True)
    phi = diagnose_agent.load_phi(toy_stages / f"{TOY}__aib_repr__1")
    plain = toy.ToyMemory(16)
    _, info = plain.reset(seed=seeds.tolist())
    states = [info["state"]]
    for action in buffer["actions"]:
        *_, info = plain.step(action.clamp(-1, 1).numpy())
        states.append(info["state"])
    u = phi(torch.from_numpy(np.stack(states)[:-1]).float()).mean
    scale = (u - u.mean(1, keepdim=True)).square().mean((1, 2), keepdim=True).sqrt()
    for size, expected in ((0.0, 1.0), (0.5**0.5, 0.5)):
        particles = u + size * scale * torch.randn_like(u)
        metrics = diagnose_agent.diagnose({**buffer, "particles": particles[:, :, None].expand(-1, -1, 30, -1)}, phi)
        assert list(metrics["u_r2"]) == [0, 5] and np.mean(list(metrics["u_r2"].values())) == pytest.approx(
            expected, abs=0.15
        )
    diagnose_agent.RecordState.rounds.clear()


def test_r_squared() -> None:
    u = torch.tensor([[0.0, 1.0], [2.0, 1.0], [4.0, 1.0]])
    assert aib_belief.r_squared(u, u) == 1 and aib_belief.r_squared(u, u.mean(0).expand(3, 2)) == 0
    assert aib_belief.r_squared(u, u + 1) == pytest.approx(1 - 6 / 8)


def test_exploration_noise_is_coloured_and_standard_normal_at_every_step() -> None:
    steps, correlation = 60, {}
    frequency = np.abs(np.fft.fftfreq(steps))
    for beta in (0.0, 0.5, 1.0, 2.0):
        noise = ppo_aib.colored_noise(beta, (4000, 8, steps), np.random.default_rng(0)).reshape(-1, steps)
        assert np.abs(noise.mean(0)).max() < 0.03, "32,000 draws a step: 5 standard errors"
        assert np.abs(noise.std(0) - 1).max() < 0.02
        power = frequency.clip(1 / steps) ** -beta
        expected = (power * np.cos(2 * np.pi * frequency)).sum() / power.sum()
        correlation[beta] = (noise[:, 1:] * noise[:, :-1]).mean()
        assert correlation[beta] == pytest.approx(expected, abs=0.01), "what the spectrum says"
    assert correlation[0.0] == pytest.approx(0, abs=0.01), "white"
    assert correlation[0.0] < correlation[0.5] < correlation[1.0] < correlation[2.0] < 1


def test_the_three_methods_explore_with_the_same_noise(toy_stages: Path) -> None:
    drawn = []
    for script in METHODS:
        module, seen = SCRIPTS[script], []
        args = module.Args(env_id=TOY, noise_beta=0.7, **small(module, toy_stages))
        if script == "ppo_baseline":
            agent = module.Agent(toy.ToyMemory(1), args)
        else:
            stored = torch.load(toy_stages / f"{TOY}__aib_belief__1" / "belief.pt", weights_only=True)
            belief = ppo_aib.AIBBelief if script == "ppo_aib" else ppo_believer.BelieverBelief
            agent = module.Agent(toy.ToyMemory(1), belief(stored["config"]), args)
        agent.register_forward_hook(lambda _, inputs, output, seen=seen: seen.append((inputs[0]["joints"], *output)))
        for seeds in (np.arange(3), np.arange(3, 6)):  # one round each
            data = module.rollout(toy.make_envs(args), agent, args, seeds)
            joints, policies, values = zip(*seen[-11:], strict=True)
            assert [x[0, 2].item() for x in joints] == pytest.approx([t / 10 for t in range(11)])
            assert torch.equal(data["values"], torch.stack(values)), "of o_0 to o_T"
            steps = zip(data["actions"], policies, strict=False)
            drawn.append(torch.stack([(action - p.mean) / p.stddev for action, p in steps]))
            noise = module.colored_noise(0.7, (3, 2, 10), np.random.default_rng(seeds)).transpose(2, 0, 1)
            assert np.allclose(drawn[-1], noise, atol=1e-4), "coloured over time"
        data = module.rollout(toy.make_envs(args), agent, args, np.arange(3), deterministic=True)
        assert torch.equal(data["actions"], torch.stack([p.mean for _, p, _ in seen[-11:-1]]))
    for other in (drawn[2], drawn[4]):
        assert torch.allclose(drawn[0], other, atol=1e-4)
    assert (drawn[0] - drawn[1]).abs().max() > 0.1, "other episodes, other noise"


@pytest.mark.parametrize("script", METHODS)
def test_an_iteration_plays_new_episodes_and_learns_from_each_step_with_its_own_return(
    toy_task: Path, toy_stages: Path, monkeypatch: pytest.MonkeyPatch, script: str
) -> None:
    module, played, seen = SCRIPTS[script], [], []
    rollout, losses = module.rollout, module.ppo_losses

    def watched_rollout(*args: object, deterministic: bool = False) -> dict:
        data = rollout(*args, deterministic=deterministic)
        played.append((not deterministic, args[3].tolist(), {name: x.clone() for name, x in data.items()}))
        return data

    monkeypatch.setattr(module, "rollout", watched_rollout)
    monkeypatch.setattr(
        module, "ppo_losses", lambda agent, batch, args: seen.append(batch) or losses(agent, batch, args)
    )
    path = train(module, **small(module, toy_stages, target_kl=1e9))
    (_, seeds, data), (_, other_seeds, other) = (one for one in played if one[0])
    evaluated, evaluated_again = (one[1] for one in played if not one[0])
    assert len({*seeds, *other_seeds, *evaluated}) == 8 + 8 + 6 and evaluated == evaluated_again
    assert seeds == [1_000_008 + i for i in range(8)] and max(other_seeds) < 2**30
    assert min(evaluated) >= 2**30 + 2**29, "stage 1's lie below"
    key, other_key = data["logprobs"], other["logprobs"]  # tells the noise, whatever the policy's means
    assert min(key.std(0).min(), key.std(1).min(), (key - other_key).std()) > 0.1, "fresh noise at every step"

    assert len(seen) == 2 * 2 * 4 and all(len(batch["actions"]) == 20 for batch in seen)
    values = data["values"]
    data["advantages"] = module.compute_gae(data["rewards"], values, 0.99, 0.9)
    data["returns"] = data["advantages"] + values[:-1]
    order = key.flatten().argsort()
    for batches in (seen[:4], seen[4:8]):
        keys = torch.cat([batch["logprobs"] for batch in batches])
        for name in seen[0]:
            x = torch.cat([batch[name] for batch in batches])
            assert torch.equal(x[keys.argsort()], data[name].flatten(0, 1)[order]), name
    assert not torch.equal(seen[0]["logprobs"], seen[4]["logprobs"]), "each pass in an order of its own"
    (group,) = torch.load(path / "checkpoint.pt", weights_only=True)["optimizer"]["param_groups"]
    assert (group["lr"], group["eps"]) == (1e-4, 1e-5)


def test_the_last_iterations_images_are_gone_when_the_next_begins(
    toy_task: Path, toy_stages: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rollout, images = ppo_baseline.rollout, []

    def watched(*args: object, **kwargs: object) -> dict:
        assert all(image() is None for image in images)
        data = rollout(*args, **kwargs)
        images.append(weakref.ref(data["rgb"]))
        return data

    monkeypatch.setattr(ppo_baseline, "rollout", watched)
    train(ppo_baseline, **small(ppo_baseline, toy_stages))
    assert len(images) == 4, "two iterations, two evaluations"


@pytest.mark.parametrize("target_kl, updates", [(1e-6, 2 * 1), (1e9, 2 * 2 * 4)])
def test_the_update_ends_at_the_kl_target(
    toy_task: Path, toy_stages: Path, monkeypatch: pytest.MonkeyPatch, target_kl: float, updates: int
) -> None:
    """Of two iterations: with a tiny target only the first minibatch, whose KL is 0, is learnt from."""
    taken, step = [], torch.optim.Adam.step
    monkeypatch.setattr(torch.optim.Adam, "step", lambda self: (taken.append(1), step(self))[1])
    path = train(ppo_baseline, **small(ppo_baseline, toy_stages, target_kl=target_kl, learning_rate=1e-2))
    assert len(taken) == updates
    events = EventAccumulator(str(path)).Reload()
    assert sum(event.value for event in events.Scalars("charts/updates")) == updates
    for event in events.Scalars("losses/approx_kl"):  # the minibatch that ended the update is in the mean
        assert (event.value > target_kl) == (target_kl < 1)


def test_an_iteration_may_end_without_an_update(
    toy_task: Path, toy_stages: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rounding between rollout and update can exceed a small KL target at the first minibatch."""
    losses = ppo_baseline.ppo_losses
    monkeypatch.setattr(ppo_baseline, "ppo_losses", lambda *args: {**losses(*args), "approx_kl": torch.tensor(1.0)})
    events = EventAccumulator(str(train(ppo_baseline, **small(ppo_baseline, toy_stages)))).Reload()
    assert {event.value for event in events.Scalars("charts/updates")} == {0}
    assert {event.value for event in events.Scalars("losses/approx_kl")} == {1}


class CountingEnvs(toy.ToyMemory):
    """Joints tell how many rounds were begun and which environment of the batch plays."""

    rounds = 0

    def reset(self, **kwargs: object) -> tuple[dict, dict]:
        self.rounds += 1
        return super().reset(**kwargs)

    def _observe(self) -> tuple[dict, dict]:
        obs, info = super()._observe()
        obs["joints"][:, 0], obs["joints"][:, 1] = self.rounds, np.arange(self.num_envs)
        return obs, info


@pytest.mark.parametrize("num_envs, rounds", [(3, [1, 1, 1, 2]), (8, [1, 1, 1, 1])])
def test_repetitions_that_fill_the_last_round_are_not_kept(num_envs: int, rounds: list[int]) -> None:
    """On physx_cuda they are other episodes, because a batch is seeded by its first seed."""
    envs, args = CountingEnvs(num_envs), ppo_baseline.Args(env_id=TOY)
    data = ppo_baseline.rollout(envs, ppo_baseline.Agent(envs, args), args, np.arange(4))
    assert (data["joints"][:, :, 0] == torch.tensor(rounds)).all()
    assert (data["joints"][:, :, 1] == torch.arange(4) % num_envs).all()


@pytest.mark.parametrize("script", ["ppo_aib", "ppo_believer"])
def test_the_belief_is_frozen_and_the_aggregator_learns(toy_task: Path, toy_stages: Path, script: str) -> None:
    module = SCRIPTS[script]
    arguments = small(module, toy_stages)
    path = train(module, **arguments)
    trained = torch.load(path / "agent.pt", weights_only=True)
    file = Path(arguments["belief"]) if script == "ppo_aib" else path / "belief.pt"
    before = torch.load(file, weights_only=True)["belief"]
    assert all(torch.equal(trained["agent"][f"belief.{name}"], value) for name, value in before.items())
    torch.manual_seed(1)
    belief = (ppo_aib.AIBBelief if script == "ppo_aib" else ppo_believer.BelieverBelief)(trained["config"])
    start = module.Agent(toy.ToyMemory(1), belief, module.Args()).state_dict()
    for part in ("w_enc.0.weight", "w_agg.2.weight", "cnn.conv.0.weight", "actor.2.weight", "log_std"):
        assert not torch.equal(trained["agent"][part], start[part]), part


@pytest.mark.parametrize("script", METHODS)
def test_any_number_of_workers_gives_the_same_training_and_evaluation(
    toy_task: Path, toy_stages: Path, script: str
) -> None:
    results = []
    for workers in (1, 3, 16):  # 3 divides neither 8 nor 6 episodes, 16 are more than there are
        arguments = small(SCRIPTS[script], toy_stages, num_workers=workers, exp_name=f"workers_{workers}")
        path = train(SCRIPTS[script], **arguments)
        rows = list(csv.DictReader((path / "eval.csv").open()))
        results.append((torch.load(path / "agent.pt", weights_only=True)["agent"], rows))
    one, *others = results
    assert len(one[1]) == 2, "after each of the two iterations"
    for other in others:
        for name, value in one[0].items():
            assert (value - other[0][name]).float().abs().mean() < 1e-6, name  # Adam turns some roundings into a step
        for row, other_row in zip(one[1], other[1], strict=True):
            assert row.keys() == other_row.keys()
            assert all(float(row[name]) == pytest.approx(float(other_row[name]), abs=1e-4) for name in row)


@pytest.mark.parametrize("script", METHODS)
def test_a_finished_run_goes_on_as_if_it_had_been_long_from_the_start(
    toy_task: Path, toy_stages: Path, script: str
) -> None:
    arguments = small(SCRIPTS[script], toy_stages)
    longer = train(SCRIPTS[script], **{**arguments, "total_timesteps": 80, "exp_name": "longer"})
    shutil.copytree(longer, "copy")  # this process still holds the lock of the old folder
    shutil.rmtree(longer)
    Path("copy").rename(longer)
    train(SCRIPTS[script], **{**arguments, "exp_name": "longer"})
    whole = train(SCRIPTS[script], **{**arguments, "exp_name": "whole"})
    assert (longer / "eval.csv").read_text() == (whole / "eval.csv").read_text()
    agents = [torch.load(path / "agent.pt", weights_only=True)["agent"] for path in (longer, whole)]
    assert all(torch.equal(x, y) for x, y in zip(agents[0].values(), agents[1].values(), strict=True))


@pytest.mark.parametrize("script", METHODS)
def test_evaluate_plays_test_episodes_with_the_stored_agent(
    toy_task: Path, toy_stages: Path, monkeypatch: pytest.MonkeyPatch, script: str
) -> None:
    module, played = SCRIPTS[script], []
    changes = dict(num_particles=5)
    if script == "ppo_baseline":
        changes = dict(image_size=40, robot_triangles=7)
    file = train(module, **small(module, toy_stages, **changes)) / "agent.pt"
    rollout = module.rollout
    monkeypatch.setattr(module, "rollout", lambda *args, **how: played.append((args, how)) or rollout(*args, **how))
    options = dict(evaluate=True, checkpoint=str(file), num_eval_episodes=4, num_workers=2)
    module.evaluate_checkpoint(module.Args(num_envs=3, amp=True, **options))
    (((_, agent, args, seeds), how),) = played
    assert (args.env_id, args.num_envs, args.amp, how) == (TOY, SMALL["num_envs"], False, {"deterministic": True})
    assert all(getattr(args, name) == value for name, value in changes.items())
    stored = torch.load(file, weights_only=True)["agent"]
    assert all(torch.equal(x, stored[name]) for name, x in agent.state_dict().items())
    assert list(seeds) == [2**30 + 2**29 + 2**20 + i for i in range(4)], "no episode of any training's evaluations"


@pytest.mark.parametrize("script", METHODS)
def test_gradients_are_clipped_before_the_step(
    toy_task: Path, toy_stages: Path, monkeypatch: pytest.MonkeyPatch, script: str
) -> None:
    norms, step = [], torch.optim.Adam.step

    def watched_step(self: torch.optim.Adam) -> None:
        if self.param_groups[0]["eps"] == 1e-5:  # PPO's, not that of Believer's belief
            grads = [x.grad for group in self.param_groups for x in group["params"] if x.grad is not None]
            norms.append(torch.stack([grad.norm() for grad in grads]).norm().item())
        step(self)

    monkeypatch.setattr(torch.optim.Adam, "step", watched_step)
    train(SCRIPTS[script], **small(SCRIPTS[script], toy_stages, max_grad_norm=1e-3, target_kl=1e9))
    assert norms == pytest.approx([1e-3] * 16, rel=0.01)


@pytest.mark.parametrize("size", [37, 91, 257])
def test_pictures_of_any_size_make_a_video(size: int) -> None:
    buffer = {"rgb": torch.zeros(3, 2, size, size, 3, dtype=torch.uint8), "success": torch.zeros(3, 2)}
    assert len(ppo_baseline.make_video(buffer)) > 1000


def test_orthogonal_initialisation() -> None:
    agent = ppo_baseline.Agent(toy.ToyMemory(1), ppo_baseline.Args())
    for layer, gain in ((agent.actor[0], 2**0.5), (agent.actor[2], 0.01 * 2**0.5), (agent.critic[2], 2**0.5)):
        gram = layer.weight @ layer.weight.T if layer.weight.shape[0] <= layer.weight.shape[1] else None
        gram = layer.weight.T @ layer.weight if gram is None else gram
        assert torch.allclose(gram, gain**2 * torch.eye(len(gram)), atol=1e-4) and (layer.bias == 0).all()
    assert torch.allclose(agent.log_std, torch.tensor(-0.5))


@pytest.mark.parametrize("script", METHODS)
def test_table_5(monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    module = SCRIPTS[script]
    tasks = {"RememberShapeAndColor3x2-v0": (10_380_000, 200, 4, 0.95), "RememberColor9-v0": (10_380_000, 200, 2, 0.95)}
    tasks |= {"InterceptMedium-v0": (10_000_000, 256, 2, 0.99), "InterceptFast-v0": (10_000_000, 256, 2, 0.99)}
    for task, values in tasks.items():
        monkeypatch.setattr(sys, "argv", ["script", "--env-id", task])
        args = module.parse_args()
        assert (args.env_id, args.total_timesteps, args.num_envs, args.update_epochs, args.gamma) == (task, *values)
        common = (args.learning_rate, args.gae_lambda, args.ent_coef, args.target_kl, args.num_minibatches)
        assert common == (1e-4, 0.9, 0.001, 0.05, 32)
        assert (args.clip_coef, args.vf_coef, args.max_grad_norm) == (0.2, 0.5, 0.5)
    monkeypatch.setattr(sys, "argv", ["script", "--quick", "--env-id=RememberColor9-v0", "--gamma", "0.5"])
    args = module.parse_args()
    assert (args.num_envs, args.gamma, args.quick, args.exp_name) == (2, 0.5, True, f"{script}_quick")


def test_small_settings_are_the_same_for_all_three_methods() -> None:
    own = {"exp_name", "num_updates", "batch_episodes", "belief_lr", "warmup_updates", "prior_nll"}
    first, *others = ({name: x for name, x in SCRIPTS[s].SMALL.items() if name not in own} for s in METHODS)
    assert first["total_timesteps"] >= 100_000 and all(first == other for other in others)
    stage_2 = {name: x for name, x in aib_belief.SMALL.items() if name != "exp_name"}
    assert stage_2.items() <= ppo_believer.SMALL.items(), "Believer's belief is trained as AIB's"


def test_help_shows_what_will_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for module in SCRIPTS.values():
        monkeypatch.setattr(sys, "argv", ["script", "--help", "--env-id", "RememberColor9-v0"])
        with pytest.raises(SystemExit):
            module.parse_args()
        shown = capsys.readouterr().out
        assert "10380000" in shown or not module.TASKS
