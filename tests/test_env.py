"""The real simulator on the CPU: what a task shows, what only the simulator knows, and that episodes repeat."""

import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sapien
import torch
from mani_skill.utils.structs import Pose

import aib_belief
import aib_repr
import ppo_baseline
from conftest import ROOT, TASK, spaces

sys.path.append(str(ROOT / "benchmark"))
import diagnose_agent  # noqa: E402
import true_state  # noqa: E402

# RememberColor9's nine colours have six hues on the screen: maroon is a dark red, olive reads as yellow, teal as cyan
HUES = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [255, 0, 255], [0, 255, 255]])
HUE_OF_CUE = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 0, 7: 3, 8: 5}


@pytest.fixture(scope="module")
def env() -> Iterator[gym.Env]:
    """One RememberColor9 in this process, as a simulator process has it."""
    env = aib_repr.make_task(aib_repr.Args(env_id=TASK), 1)
    yield env
    env.close()


def cubes(image: np.ndarray, empty: np.ndarray) -> dict[int, int]:
    """Pixels per hue where the table, seen below the arm, differs from the empty one."""
    image, empty = image[58:].astype(float), empty[58:].astype(float)
    pixels = image[np.abs(image - empty).max(-1) > 60]
    unit = [x / np.linalg.norm(x, axis=1, keepdims=True) for x in (pixels, HUES)]
    hue, count = np.unique((unit[0] @ unit[1].T).argmax(1), return_counts=True)
    return dict(zip(hue.tolist(), count.tolist(), strict=True))


def test_cue_then_nothing_then_nine_cubes_that_rest_on_the_table(env: gym.Env) -> None:
    seen = [env.reset(seed=11)]
    for _ in range(14):
        obs, _, _, _, info = env.step(np.zeros(8, np.float32))
        seen.append((obs, info))
    images, cue = [obs["rgb"] for obs, _ in seen], int(seen[0][1]["cue"][0])
    for t in range(5):
        found = cubes(images[t], images[7])
        assert max(found, key=found.get) == HUE_OF_CUE[cue] and sum(found.values()) > 8, (t, found)
    for t in range(5, 10):
        assert sum(cubes(images[t], images[7]).values()) == 0, t
    for t in range(10, 15):
        found = cubes(images[t], images[7])
        assert all(found[hue] > 32 for hue in (0, 3, 5)), "two cubes each"
        assert all(8 < found[hue] < 32 for hue in (1, 2, 4)), "one cube each"
    for _, info in seen:
        assert np.isfinite(info["state"]).all() and np.abs(info["state"]).max() < 100, "no sentinel, no NaN"
        assert info["cue"] == [cue]
    heights = [float(cube.pose.p[0, 2]) for cube in env.unwrapped.cubes.values()]
    assert np.allclose(heights, 0.02, atol=0.005), "as on the GPU simulator, instead of falling from z = 1000"


def test_the_batch_of_physx_cuda_is_played_and_recorded(
    env: gym.Env, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """ManiSkill's batched environment, here one scene of its CPU simulator, gives what the usual process does."""
    make_task = aib_repr.make_task  # .env: without the wrapper that takes the batch away
    for script in (aib_repr, ppo_baseline):
        monkeypatch.setattr(script, "make_task", lambda args, num_scenes: make_task(aib_repr.Args(env_id=TASK), 1).env)
    args = aib_repr.Args(env_id=TASK, sim_backend="physx_cuda", num_episodes=2, num_envs=1)
    arrays = aib_repr.collect_random_episodes(args, tmp_path / "dataset")
    obs, info = env.reset(seed=1_000_001 + 2**30)
    assert np.array_equal(arrays["rgb"][1, 0], obs["rgb"]) and np.array_equal(arrays["state"][1, 0], info["state"])
    for t in range(60):
        obs, reward, _, _, info = env.step(arrays["actions"][1, t])
    assert np.allclose(arrays["joints"][1, 60], obs["joints"], atol=1e-3)
    assert arrays["rewards"][1, 59] == pytest.approx(reward, abs=1e-3) and arrays["cue"][1] == info["cue"]

    envs = ppo_baseline.make_envs(ppo_baseline.Args(env_id=TASK, sim_backend="physx_cuda", num_envs=1))
    agent = ppo_baseline.Agent(envs, ppo_baseline.Args())
    data = ppo_baseline.rollout(envs, agent, ppo_baseline.Args(env_id=TASK), np.array([5, 6]))
    assert data["rgb"].shape == (60, 2, 128, 128, 3) and data["values"].shape == (61, 2)
    for i, seed in enumerate((5, 6)):
        assert np.array_equal(data["rgb"][0, i], env.reset(seed=seed)[0]["rgb"])


def test_the_true_state_stands_behind_the_joints_and_nothing_is_drawn(env: gym.Env) -> None:
    shown = true_state.ShowState(env, pictures=True)
    obs, _ = shown.reset(seed=3)
    agent = true_state.StateAgent(spaces([128, 128, 3], len(obs["joints"]), 8), true_state.Args(pictures=True))
    pictures = {"rgb": torch.from_numpy(np.stack([obs["rgb"], 255 - obs["rgb"]]))}
    _, value = agent({**pictures, "joints": torch.zeros(2, len(obs["joints"]))})
    assert value[0] != value[1], "it sees the picture"
    shown = true_state.ShowState(env)
    for obs, *_, info in (shown.reset(seed=3), shown.step(np.zeros(8, np.float32))):
        assert obs in shown.observation_space and obs["rgb"].shape == (1, 1, 3)
        assert np.array_equal(obs["joints"][25:], info["state"]) and info["state"].any()
    shown_spaces = spaces([1, 1, 3], len(obs["joints"]), 8)
    agent = true_state.StateAgent(shown_spaces, true_state.Args())
    joints = torch.from_numpy(np.stack([obs["joints"], obs["joints"]]))
    joints[1, -1] += 1
    policy, value = agent({"joints": joints})
    assert policy.mean.shape == (2, 8) and value[0] != value[1], "it sees the state"
    joints[:, -1] = torch.tensor([20.0, 2000.0])
    value = agent({"joints": joints})[1]
    assert torch.allclose(value[0], value[1], atol=1e-5), "inputs are clipped"
    phi = aib_belief.StateEncoder(len(info["state"]), 16)
    agent = true_state.StateAgent(shown_spaces, true_state.Args(), phi)
    assert agent.joints[0].in_features == 25 + 16
    joints[:, -1] = torch.tensor([0.0, 1.0])
    first = agent({"joints": joints})[1]
    phi.mean[-1] += 1  # now the second state is to phi what the first was
    assert torch.allclose(agent({"joints": joints})[1][1], first[0], atol=1e-5), "it sees u"
    joints[:, -1] = torch.tensor([1e9, 2e9])
    value = agent({"joints": joints})[1]
    assert torch.allclose(value[0], value[1], atol=1e-5), "u is clipped"
    shown = true_state.ShowState(env, target=True)
    shown.reset(seed=3)
    for _ in range(12):  # until the objects stand on the table
        obs, *_ = shown.step(np.zeros(8, np.float32))
    tcp, target = obs["joints"][18:21], obs["joints"][25:]
    assert np.allclose(target - tcp, env.unwrapped.obj_to_goal_pos, atol=1e-4)
    del env.unwrapped._get_obs_sensor_data


def test_nearest_object_tells_the_right_one(env: gym.Env) -> None:
    task, told = env.unwrapped, diagnose_agent.NearestObject(env)
    _, info = told.reset(seed=5)
    right = int(info["cue"][0])
    for _ in range(12):  # until the objects stand on the table
        told.step(np.zeros(8, np.float32))
    for key in (right, (right + 1) % 9, right):
        hand = task.agent.tcp.pose.p
        for other, cube in task.cubes.items():
            place = hand + torch.tensor([[0.0, 0.0, 0.05 if other == key else 0.5 + other]])
            cube.pose = Pose.create_from_pq(place, cube.pose.q)
        assert told.step(np.zeros(8, np.float32))[1] == (key == right)
    buffer = {"rewards": torch.tensor([[1.0, 1.0], [0.0, 1.0]]), "success": torch.tensor([[1.0, 0.0], [0.0, 0.0]])}
    metrics = {"nearest_is_right": 0.5, "success_once": 0.5, "success_at_end": 0.0}
    assert diagnose_agent.diagnose(buffer, None) == metrics


def test_light_meshes_change_a_hundredth_of_the_pixels_and_no_object_on_the_table() -> None:
    """Against MIKASA-Robo's own environment of a task that hides nothing, which its CPU simulator would lose."""
    task = "InterceptFast-v0"
    modes = dict(obs_mode="rgb", control_mode="pd_joint_delta_pos", reward_mode="normalized_dense")
    backends = dict(sim_backend="physx_cpu", render_backend="sapien_cpu", robot_uids="panda_wristcam")
    stock = gym.make(task, num_envs=1, **modes, **backends)
    light = aib_repr.make_task(aib_repr.Args(env_id=task), 1)
    stock_obs, light_obs = stock.reset(seed=1)[0], light.reset(seed=1)[0]
    rng, difference = np.random.default_rng(0), []
    for _ in range(20):
        action = rng.uniform(-1, 1, 8).astype(np.float32)
        stock_obs, light_obs = stock.step(action)[0], light.step(action)[0]
        assert np.array_equal(stock_obs["agent"]["qpos"][0].numpy(), light_obs["joints"][:9])
        picture = stock_obs["sensor_data"]["base_camera"]["rgb"][0].numpy().astype(int)
        difference.append(np.abs(picture - light_obs["rgb"]))
    difference = np.stack(difference)
    assert 0.001 < (difference.max(-1) > 16).mean() < 0.015 and difference.mean() < 0.8
    assert difference[:, :30, :40].max() <= 1, "the ground behind the table, of two triangles"
    assert picture[:30, :40].std() > 5, "it has a pattern"

    def shapes(env: gym.Env, name: str) -> list:
        body = env.unwrapped.scene.actors[name]._objs[0].find_component_by_type(sapien.render.RenderBodyComponent)
        parts = [part for shape in body.render_shapes for part in shape.parts]
        return [(part.vertices.tolist(), part.triangles.tolist()) for part in parts]

    names = set(stock.unwrapped.scene.actors) - {"ground"}
    assert {"ball", "goal_region"} <= names
    assert len(shapes(light, "ground")[0][1]) == 2
    assert all(shapes(stock, name) == shapes(light, name) for name in names)


def test_random_actions_are_uniform_and_independent() -> None:
    args = aib_repr.Args()
    actions = np.stack([aib_repr.random_actions(args, episode, 60, 8) for episode in range(2000)])
    assert actions.shape == (2000, 60, 8) and actions.dtype == np.float32 and np.abs(actions).max() <= 1
    deciles = np.quantile(actions.transpose(1, 0, 2).reshape(60, -1), np.linspace(0.1, 0.9, 9), axis=1)
    assert np.abs(deciles - np.linspace(-0.8, 0.8, 9)[:, None]).max() < 0.06, "at every step"
    assert abs(np.corrcoef(actions[:, 1:].ravel(), actions[:, :-1].ravel())[0, 1]) < 0.01
    assert np.array_equal(actions[7], aib_repr.random_actions(args, 7, 60, 8))
    assert not np.array_equal(actions[7], aib_repr.random_actions(aib_repr.Args(seed=2), 7, 60, 8))


def test_success_and_reward_are_the_tasks_own(env: gym.Env) -> None:
    task = env.unwrapped
    _, info = env.reset(seed=11)
    cue, action, found = int(info["cue"][0]), np.zeros(8, np.float32), []
    for t in range(16):
        if t == 14:  # the right cube, put into the hand
            task.cubes[cue].set_pose(Pose.create_from_pq(task.agent.tcp.pose.p, task.cubes[cue].pose.q))
        _, reward, _, _, info = env.step(action)
        own = task.evaluate()
        expected = task.compute_normalized_dense_reward(obs=None, action=torch.from_numpy(action)[None], info=own)
        assert info["success"] == float(own["success"]) and reward == pytest.approx(float(expected), abs=1e-5)
        found.append((float(info["success"]), float(reward)))
    successes, rewards = zip(*found, strict=True)
    assert not any(successes[:14]) and any(successes[14:]), "both values are compared"
    assert max(rewards[:14]) < max(rewards[14:]) <= 1


def test_hidden_shapes_come_back_to_the_table() -> None:
    env = aib_repr.make_task(aib_repr.Args(env_id="RememberShapeAndColor3x2-v0"), 1)
    env.reset(seed=5)
    task, heights = env.unwrapped, []
    for _ in range(20):
        env.step(np.zeros(8, np.float32))
        heights.append([float(x.pose.p[0, 2]) for x in task.shapes.values()])
    env.close()
    assert np.allclose(heights[10:], heights[-1], atol=2e-3) and np.min(heights[-1]) > 0 and np.max(heights[-1]) < 0.1
