#!/usr/bin/env bash
# Train on all devices of a job: one process each, started by srun. Submit it from the project's
# folder with the layers of 'l3r train', resources before the script's name:
#
#   sbatch --nodes=2 --ntasks-per-node=8 slurm/train.sh configs/base.yaml configs/model/l3r_224.yaml \
#       configs/train/paper_224.yaml data.sources.waymo.shards=shards/waymo ...
#
# The same with --time=0:20:00 before the script's name and --dry-run at the end tries data, memory
# and a few steps, and writes nothing but its log.
#
# Two minutes before the time limit it saves, requeues itself and goes on later; so does a job that
# is preempted or loses a node. Submitted again, it goes on where it stopped.
# Account, partition, modules and Python come from slurm/site.env; see docs/cluster.md.
#SBATCH --job-name=l3r-train
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=8
#SBATCH --gpus-per-node=8
#SBATCH --cpus-per-task=8
#SBATCH --mem=0
#SBATCH --time=1-00:00:00
#SBATCH --output=l3r-train-%j.log
#SBATCH --open-mode=append
#SBATCH --requeue
#SBATCH --signal=USR1@120
set -eo pipefail

refuse() {
    printf 'train.sh: %s\n' "$1" >&2
    exit 2
}

if [[ -z ${SLURM_JOB_ID:-} || $# -eq 0 ]]; then
    refuse "no SLURM job with layers of 'l3r train'; submit it: sbatch slurm/train.sh configs/base.yaml configs/model/l3r_512.yaml configs/train/paper_512.yaml KEY=VALUE ..."
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

# Where the processes meet. Set it where the names of nodes do not resolve, or to choose a network.
if [[ -z ${MASTER_ADDR:-} ]]; then
    MASTER_ADDR=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
fi
export MASTER_ADDR

# Copy shards that stand on the command line to a disk of each node, unless they are there: whole
# folders appear under their name, so that a job that was killed leaves nothing half copied.
layers=()
for layer in "$@"; do
    folder=${layer#*=}
    if [[ -n ${L3R_STAGE_DIR:-} && $layer =~ ^data\.(sources|validation)\..+\.shards= && -d $folder ]]; then
        folder=$(realpath "$folder")
        staged=$L3R_STAGE_DIR/${folder//\//_}
        # shellcheck disable=SC2016
        srun --ntasks="$SLURM_JOB_NUM_NODES" --ntasks-per-node=1 bash -ec '
            cmp -s "$1/manifest.json" "$2/manifest.json" && exit 0
            rm -rf "$2" "$2.part" && mkdir -p "$2.part"
            cp -r "$1/." "$2.part" && mv "$2.part" "$2"' stage "$folder" "$staged"
        layer=${layer%%=*}=$staged
    fi
    layers+=("$layer")
done

# srun takes the number of CPUs from its own options alone. A process that dies ends the others.
cpus=${SLURM_CPUS_PER_TASK:-1}
printf '%s %s: %s processes on %s: l3r train %s\n' "$(date '+%F %T')" "$SLURM_JOB_ID" \
    "${SLURM_NTASKS:-1}" "$SLURM_JOB_NODELIST" "${layers[*]}" >&2
# A run in a container has no scontrol and makes this file, to be requeued from here. SIGTERM is for
# the run, which saves; this shell waits for it.
export L3R_REQUEUE_FILE=$SLURM_SUBMIT_DIR/.l3r-requeue-$SLURM_JOB_ID
rm -f "$L3R_REQUEUE_FILE"  # that of a shell which was killed before it could obey
trap : TERM
code=0
srun --kill-on-bad-exit=1 --cpus-per-task="$cpus" l3r train "${layers[@]}" || code=$?
if [[ -e $L3R_REQUEUE_FILE ]]; then
    rm "$L3R_REQUEUE_FILE"
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
