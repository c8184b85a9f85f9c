"""What does Believer's belief remember? Trains it where it is missing and probes it as aib_belief.py probes AIB's.

Prints what the beliefs of this task in runs/ remember; train those to compare with on the same run of stage 1.

Usage:   python aib_belief.py --env-id RememberColor3-v0 --small
         python aib_belief.py --env-id RememberColor3-v0 --small --action-head none --exp-name aib_belief_none
         python benchmark/belief.py --env-id RememberColor3-v0 --small
Takes:   the arguments of ppo_believer.py
Writes:  belief.pt, as ppo_believer.py, which goes on from it, and diagnostics.json, as aib_belief.py
"""

import json
import sys
from pathlib import Path

import numpy as np
import report
import torch
from torch.distributions import Normal

sys.path.insert(0, str(Path(__file__).parent.parent))
import aib_belief  # noqa: E402
import ppo_believer  # noqa: E402


def main(args: ppo_believer.Args) -> None:
    """Train Believer's belief, write its diagnostics.json, print the table."""
    path = ppo_believer.open_run(args)
    episodes, stored = ppo_believer.load_episodes(args)
    if not (path / "belief.pt").exists():
        ppo_believer.train_belief(args, path)
    belief = ppo_believer.BelieverBelief(ppo_believer.load(path / "belief.pt")["config"])
    belief.prior = lambda h: Normal(h.new_zeros(*h.shape[:-1], args.z_dim), 1.0)
    posterior = ppo_believer.GaussianMLP(stored["u_dim"] + 256, [256, 256], args.z_dim, min_std=0.1)
    model = torch.nn.ModuleDict({"belief": belief, "posterior": posterior})
    model["teacher"], model["locator"] = ppo_believer.Teacher(stored["u_dim"]), ppo_believer.Locator(stored["u_dim"])
    model.load_state_dict(ppo_believer.load(path / "belief_checkpoint.pt")["model"])
    model.to(args.device)
    held_out = np.arange(len(episodes))[-stored["num_val"] :]
    fit_on, test_on = np.split(held_out, [len(held_out) - len(held_out) // 2])  # as in aib_belief.main
    fit, test = (aib_belief.encode(belief, posterior, episodes, index) for index in (fit_on, test_on))
    ppo_believer.save(path / "diagnostics.json", json.dumps(aib_belief.probe_belief(fit, test), indent=2).encode())
    beliefs = report.select(report.collect(Path("runs"))["beliefs.csv"], task=args.env_id)
    print(report.beliefs_table(beliefs, [(args.env_id, setting) for setting in beliefs.setting.unique()]))


if __name__ == "__main__":
    main(ppo_believer.parse_args())
