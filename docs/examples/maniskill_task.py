"""AIB on a ManiSkill task that is not MIKASA-Robo's, made from PushCube-v1.

The tool must go to a disc on the table. The disc is visible in the first five pictures only, so the robot must remember
where it was. PushCube-v1's cube lies there, too, and does not matter.

Usage:   python docs/examples/maniskill_task.py --small
Takes:   --method aib, believer or ppo, and the arguments that all scripts have: --seed, --device, --small, --quick
Writes:  what the method's scripts write, to runs/RememberDisc-v0__...
"""

import argparse
import sys
from pathlib import Path

import torch
from mani_skill.envs.tasks import PushCubeEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

sys.path.insert(0, str(Path(__file__).parents[2]))
import aib_belief  # noqa: E402
import aib_repr  # noqa: E402
import ppo_aib  # noqa: E402
import ppo_baseline  # noqa: E402
import ppo_believer  # noqa: E402

TASK = "RememberDisc-v0"
SCRIPTS = {  # of each method, in order
    "aib": (aib_repr, aib_belief, ppo_aib),
    "believer": (aib_repr, ppo_believer),
    "ppo": (ppo_baseline,),
}


@register_env(TASK, max_episode_steps=50)
class RememberDisc(PushCubeEnv):
    """What PrivilegedInfoWrapper needs beyond a task's usual methods is oracle_info.

    The camera base_camera, the tool's pose and, as privileged state, the poses of disc and cube come from PushCube-v1.
    """

    SUPPORTED_ROBOTS = ["panda", "panda_wristcam"]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        pose = self.goal_region.pose.raw_pose.clone()
        place = self._batched_episode_rng[env_idx].uniform([0.0, -0.2], [0.2, 0.2])
        pose[:, :2] = torch.as_tensor(place, dtype=torch.float32, device=self.device)
        self.goal_region.set_pose(Pose.create(pose))
        self.oracle_info = pose[:, :2]  # the memory variable (B, 2), which becomes info["cue"]

    def evaluate(self) -> dict:
        """Show or hide the disc before the picture is taken; all scenes of a batch are at the same step."""
        if self.elapsed_steps[0] < 5:
            self.goal_region.show_visual()
        else:
            self.goal_region.hide_visual()
        distance = torch.linalg.norm(self.agent.tcp.pose.p - self.goal_region.pose.p, dim=1)
        return {"success": distance < 0.05, "distance": distance}

    def compute_normalized_dense_reward(self, obs: dict, action: torch.Tensor, info: dict) -> torch.Tensor:
        """At most 1 a step, and different for different discs whatever the robot does: else u would not hold them."""
        return 1 - torch.tanh(5 * info["distance"])


def main() -> None:
    """Run a method's scripts one after another, with the arguments of the command line."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--method", choices=SCRIPTS, default="aib")
    chosen, others = parser.parse_known_args()
    sys.argv[1:] = [*others, "--env-id", TASK]
    scripts = SCRIPTS[chosen.method]
    for script in scripts:
        script.check_task = lambda args: None  # the scripts' own refuses tasks that are not MIKASA-Robo's
    arguments = [script.parse_args() for script in scripts]  # all before any runs: a mistake shows at once
    for script, args in zip(scripts, arguments, strict=True):
        script.main(args)


if __name__ == "__main__":  # the simulator's processes import this file, too, which registers the task there
    main()
