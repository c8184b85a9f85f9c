#!/bin/bash
#SBATCH --job-name=aib
#SBATCH --gpus=1
#SBATCH --cpus-per-task=16
#SBATCH --mem=64G
#SBATCH --time=12:00:00
#SBATCH --requeue
#SBATCH --signal=B:USR1@120
#SBATCH --output=runs/slurm-%x-%A_%a.log
#SBATCH --open-mode=append
#
# Submit all of the paper's experiments with one line, from the repository's root:   bash benchmark/slurm.sh
# or some, with arguments of experiments.py:   bash benchmark/slurm.sh --small --tasks RememberColor3-v0
# Three job arrays follow one another: stage 1, the beliefs, PPO. A job that is preempted or runs into its time limit
# is queued again and goes on from its last checkpoint. Where a job fails the later arrays are cancelled: submit again,
# finished commands do nothing. Change the lines above to what your cluster wants.
set -euo pipefail
export TQDM_MININTERVAL=30  # seconds between two states of a progress bar: each is a line of the log

if [ -z "${SLURM_ARRAY_TASK_ID:-}" ]; then
    mkdir -p runs
    after=
    for phase in 1 2 3; do
        count=$(.venv/bin/python benchmark/experiments.py "$@" --phase "$phase" | wc -l)
        job=$(sbatch --parsable --array="1-$count" $after --export="ALL,PHASE=$phase" "$0" "$@")
        echo "phase $phase: $count jobs, array $job"
        after="--dependency=afterok:$job --kill-on-invalid-dep=yes"
    done
    exit 0
fi

command=$(.venv/bin/python benchmark/experiments.py "$@" --phase "$PHASE" | sed -n "${SLURM_ARRAY_TASK_ID}p")
echo "$command"
$command &
child=$!
# an abrupt end loses nothing but the work since the last checkpoint
trap 'scontrol requeue "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}"; kill "$child"' USR1
wait "$child"
