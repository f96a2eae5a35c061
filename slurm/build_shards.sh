#!/usr/bin/env bash
# Build shards with an array of jobs: every task of the array writes its part, the last one to
# finish writes manifest.json. Submit it from the project's folder with the options of
# 'l3r-prep build', resources before the script's name:
#
#   sbatch --array=0-15 slurm/build_shards.sh tartanair --raw TartanAir/ --out shards/tartanair
#
# Requeued, or submitted again when none of its jobs is left, it goes on where it stopped. To redo
# tasks 3 and 7 of 16 while others run: sbatch --array=3,7 slurm/build_shards.sh ... --tasks 16
# Account, partition, modules and Python come from slurm/site.env; see docs/cluster.md.
#SBATCH --job-name=l3r-shards
#SBATCH --array=0-7
#SBATCH --cpus-per-task=8
#SBATCH --mem=32G
#SBATCH --time=1-00:00:00
#SBATCH --output=l3r-shards-%A_%a.log
#SBATCH --open-mode=append
#SBATCH --requeue
set -eo pipefail

refuse() {
    printf 'build_shards.sh: %s\n' "$1" >&2
    exit 2
}

if [[ -z ${SLURM_JOB_ID:-} || $# -eq 0 ]]; then
    refuse "no SLURM job with options of 'l3r-prep build'; submit it: sbatch --array=0-15 slurm/build_shards.sh DATASET --raw RAW --out OUT"
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
        refuse "the IDs of this array are not evenly spaced; say how many tasks there were, as --tasks 16, or submit a range"
    fi
    share=(--tasks "$count" --task-index "$(((id - first) / step))")
fi

# srun takes the number of CPUs from its own options alone; those of the user come last and win.
cpus=${SLURM_CPUS_PER_TASK:-1}
printf '%s %s: %s on %s: l3r-prep build %s\n' "$(date '+%F %T')" "$SLURM_JOB_ID" \
    "${share[*]}" "${SLURMD_NODENAME:-$HOSTNAME}" "$*" >&2
exec srun --nodes=1 --ntasks=1 --cpus-per-task="$cpus" \
    l3r-prep build --workers "$cpus" "${share[@]}" "$@"
