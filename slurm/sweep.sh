#!/usr/bin/env bash
# Train and score the runs of a sweep with an array of jobs: every task of the array does its share
# of the runs, one after the other, each on all devices of the task. Submit it from the project's
# folder with the arguments of 'l3r sweep', resources before the script's name:
#
#   sbatch --array=0-8 slurm/sweep.sh configs/sweep/num_layers.yaml \
#       data.sources.waymo.shards=shards/waymo data.validation.waymo.shards=shards/waymo_val ...
#
# or let 'l3r sweep ... --submit' submit what is left. Each task writes the tables anew when it is
# through, so that after the last one they are whole. Two minutes before its time limit a task
# saves, requeues itself and goes on later; so does one that is preempted or loses a node.
# Account, partition, modules and Python come from slurm/site.env; see docs/cluster.md.
#SBATCH --job-name=l3r-sweep
#SBATCH --array=0-8
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=8
#SBATCH --gpus-per-node=8
#SBATCH --cpus-per-task=8
#SBATCH --mem=0
#SBATCH --time=1-00:00:00
#SBATCH --output=l3r-sweep-%A_%a.log
#SBATCH --open-mode=append
#SBATCH --requeue
#SBATCH --signal=B:USR1@120
set -eo pipefail

refuse() {
    printf 'sweep.sh: %s\n' "$1" >&2
    exit 2
}

if [[ -z ${SLURM_JOB_ID:-} || $# -eq 0 ]]; then
    refuse "no SLURM job with arguments of 'l3r sweep'; submit it: sbatch --array=0-8 slurm/sweep.sh configs/sweep/num_layers.yaml KEY=VALUE ..."
fi

# SLURM runs a copy of this file, so what lies beside it is found from where it was submitted.
site=${L3R_SITE_ENV:-$SLURM_SUBMIT_DIR/slurm/site.env}
if [[ -f $site ]]; then
    # shellcheck source=/dev/null
    source "$site"
elif [[ -n ${L3R_SITE_ENV:-} ]]; then
    refuse "L3R_SITE_ENV is $site, expected a file; see slurm/site.env.example"
fi
# From here on, as modules and activation scripts may read variables that are not set.
set -u

# Where the processes of a training meet. Set it where names of nodes do not resolve.
if [[ -z ${MASTER_ADDR:-} ]]; then
    MASTER_ADDR=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
fi
export MASTER_ADDR

# Which task of how many this is: the array's IDs in order, or, with --tasks, the ID itself.
id=${SLURM_ARRAY_TASK_ID:-0} first=${SLURM_ARRAY_TASK_MIN:-0} last=${SLURM_ARRAY_TASK_MAX:-0}
count=${SLURM_ARRAY_TASK_COUNT:-1}
if [[ " $* " =~ \ --tasks[=\ ] ]]; then
    share=(--task-index "$id")
else
    gaps=$((count > 1 ? count - 1 : 1))
    step=$(((last - first) / gaps))
    step=$((step > 0 ? step : 1))
    # Where they are not evenly spaced, at least one of them fails this.
    if (((last - first) % gaps || (id - first) % step)); then
        refuse "the IDs of this array are not evenly spaced; say how many tasks there were, as --tasks 9, or submit a range"
    fi
    share=(--tasks "$count" --task-index "$(((id - first) / step))")
fi

# srun takes the number of CPUs from its own options alone. In place of this shell, so that the
# signal before the time limit arrives there.
cpus=${SLURM_CPUS_PER_TASK:-1}
printf '%s %s: %s on %s: l3r sweep %s\n' "$(date '+%F %T')" "$SLURM_JOB_ID" \
    "${share[*]}" "$SLURM_JOB_NODELIST" "$*" >&2
exec l3r sweep "${share[@]}" --launcher "srun --kill-on-bad-exit=1 --cpus-per-task=$cpus" "$@"
