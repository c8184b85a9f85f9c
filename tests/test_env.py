"""The real simulator, through the scripts' own make_envs on the CPU."""

import numpy as np
import pytest

import aib_repr

pytestmark = pytest.mark.slow

# RememberColor9's nine colours have six hues on the screen: maroon is a dark red, olive reads as yellow, teal as cyan
HUES = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [255, 0, 255], [0, 255, 255]])
HUE_OF_CUE = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 0, 7: 3, 8: 5}


def play_still(env_id: str, workers: int, seeds: list[int], steps: int) -> list[tuple[dict, dict]]:
    """Observations and infos of one episode per seed under zero actions."""
    args = aib_repr.Args(env_id=env_id, robot="panda", num_workers=workers)
    args = aib_repr.resolve(args, aib_repr.QUICK)
    seen = []
    with aib_repr.simulator(args, len(seeds)) as envs:
        for first in range(0, len(seeds), workers):
            obs, info = envs.reset(seed=seeds[first : first + workers])
            seen.append((obs, info))
            for _ in range(steps):
                obs, _, _, _, info = envs.step(np.zeros(envs.action_space.shape, np.float32))
                seen.append((obs, info))
    return seen


def cubes(image: np.ndarray, empty: np.ndarray) -> dict[int, int]:
    """Pixels per hue where the table, seen below the arm, differs from the empty one."""
    image, empty = image[58:].astype(float), empty[58:].astype(float)
    pixels = image[np.abs(image - empty).max(-1) > 60]
    unit = [x / np.linalg.norm(x, axis=1, keepdims=True) for x in (pixels, HUES)]
    hue, count = np.unique((unit[0] @ unit[1].T).argmax(1), return_counts=True)
    return dict(zip(hue.tolist(), count.tolist(), strict=True))


def test_remember_color_shows_cue_then_nothing_then_nine_cubes() -> None:
    seen = play_still("RememberColor9-v0", 1, [11], 14)
    cue, empty = int(seen[0][1]["cue"][0, 0]), seen[7][0]["rgb"][0]
    for t in range(5):
        found = cubes(seen[t][0]["rgb"][0], empty)
        assert max(found, key=found.get) == HUE_OF_CUE[cue] and sum(found.values()) > 8, (t, found)
    for t in range(5, 10):
        assert sum(cubes(seen[t][0]["rgb"][0], empty).values()) == 0, t
    for t in range(10, 15):
        found = cubes(seen[t][0]["rgb"][0], empty)
        assert all(found[hue] > 32 for hue in (0, 3, 5)), "two cubes each"
        assert all(8 < found[hue] < 32 for hue in (1, 2, 4)), "one cube each"
    for _, info in seen:
        assert np.isfinite(info["state"]).all() and np.abs(info["state"]).max() < 100, "no sentinel, no NaN"
        assert (info["cue"] == cue).all()


def test_hidden_cubes_stay_where_they_are() -> None:
    """After the delay every cube rests on the table, as on the GPU simulator, instead of falling from z = 1000."""
    args = aib_repr.resolve(aib_repr.Args(env_id="RememberColor9-v0", robot="panda"), aib_repr.QUICK)
    env = aib_repr.make_task(args, 1)
    env.reset(seed=5)
    for _ in range(12):
        env.step(np.zeros(env.action_space.shape, np.float32))
    heights = [float(cube.pose.p[0, 2]) for cube in env.unwrapped.cubes.values()]
    assert np.allclose(heights, 0.02, atol=0.005)
    env.close()


def test_the_same_seed_gives_the_same_episode_on_any_number_of_workers() -> None:
    seeds = [3, 4]
    one, two = (play_still("InterceptFast-v0", workers, seeds, 6) for workers in (1, 2))
    for episode in range(2):
        for t in range(7):
            (obs1, info1), (obs2, info2) = one[episode * 7 + t], two[t]
            for name in ("rgb", "joints"):
                assert np.array_equal(obs1[name][0], obs2[name][episode]), (name, t)
            for name in ("state", "cue", "success"):
                assert np.array_equal(info1[name][0], info2[name][episode]), (name, t)
    assert not np.array_equal(one[0][0]["rgb"], one[7][0]["rgb"]), "two seeds are two episodes"
