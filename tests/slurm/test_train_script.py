"""slurm/train.sh without a cluster: what it would run, and what it refuses."""

import subprocess

import pytest

from tests.slurm.cluster import ROOT

TRAIN = ROOT / "slurm" / "train.sh"
TOOLS = {
    # Tasks of a job step that is no training run here; training is printed.
    "srun": 'case " $* " in *" l3r train "*) printf "%s\\n" "$MASTER_ADDR" "$@"; exit;; esac\n'
    'while [ "$1" != bash ]; do shift; done\nexec "$@"\n',
    "scontrol": '[ "$*" = "show hostnames n[4-5]" ] && printf "n4\\nn5\\n" && exit\n'
    'echo "$*" >&2; exit 1\n',
}


@pytest.fixture
def run_job(tmp_path):
    """Run the script as SLURM would, with tools of its own in its path."""
    tools = tmp_path / "tools"
    tools.mkdir()
    for name, body in TOOLS.items():
        (tools / name).write_text(f"#!/bin/sh\n{body}")
        (tools / name).chmod(0o755)

    def run(*args, **variables):
        env = {
            "PATH": f"{tools}:/usr/bin:/bin",
            "SLURM_JOB_ID": "7",
            "SLURM_SUBMIT_DIR": str(tmp_path),
            "SLURM_JOB_NODELIST": "n[4-5]",
            "SLURM_JOB_NUM_NODES": "2",
            "SLURM_CPUS_PER_TASK": "3",
            **variables,
        }
        command = ["bash", str(TRAIN), *args]
        return subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, text=True)

    return run


@pytest.fixture
def shards(tmp_path):
    folder = tmp_path / "my shards"
    folder.mkdir()
    (folder / "manifest.json").write_text("{}")
    (folder / "a.tar").write_text("tar")
    return folder


def test_every_process_gets_the_layers_as_given_and_meets_on_the_first_node(run_job):
    done = run_job("a.yaml", "train.note=two words", "--dry-run")
    assert done.stdout.splitlines() == [
        *("n4", "--kill-on-bad-exit=1", "--cpus-per-task=3"),
        *("l3r", "train", "a.yaml", "train.note=two words", "--dry-run"),
    ]


def test_the_place_to_meet_can_be_set(run_job):
    assert run_job("a.yaml", MASTER_ADDR="127.0.0.1").stdout.startswith("127.0.0.1\n")


def test_shards_of_the_command_line_are_copied_once_and_read_from_the_copy(
    run_job, shards, tmp_path
):
    local = tmp_path / "local"
    layers = [
        "a.yaml",
        f"data.sources.room.shards={shards}",
        "data.validation.far.shards=https://host/shards",
        "train.output_dir=runs/a=b",
    ]
    done = run_job(*layers, L3R_STAGE_DIR=str(local))
    copy = local / str(shards).replace("/", "_")
    expected = ["a.yaml", f"data.sources.room.shards={copy}", *layers[2:]]
    assert done.stdout.splitlines()[-4:] == expected, done.stderr
    assert sorted(path.name for path in copy.iterdir()) == ["a.tar", "manifest.json"]
    assert [*local.iterdir()] == [copy]
    (copy / "mark").touch()
    run_job(*layers, L3R_STAGE_DIR=str(local))
    assert (copy / "mark").exists(), "copied again"
    (shards / "manifest.json").write_text('{"new": 1}')
    run_job(*layers, L3R_STAGE_DIR=str(local))
    assert not (copy / "mark").exists()


def test_a_copy_that_fails_starts_no_training(run_job, shards, tmp_path):
    (tmp_path / "file").touch()
    stage = str(tmp_path / "file")
    done = run_job(f"data.sources.room.shards={shards}", L3R_STAGE_DIR=stage)
    assert done.returncode != 0
    assert "l3r" not in done.stdout


def test_what_a_killed_job_asked_for_does_not_requeue_a_later_one(run_job, tmp_path):
    left = tmp_path / ".l3r-requeue-7"
    left.touch()
    done = run_job("a.yaml")
    assert (done.returncode, done.stderr.count("requeue")) == (0, 0)
    assert not left.exists()


@pytest.mark.parametrize(("args", "job"), [(("a.yaml",), ""), ((), "7")], ids=["no job", "nothing"])
def test_outside_slurm_it_says_how_to_submit(run_job, args, job):
    done = run_job(*args, SLURM_JOB_ID=job)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert "sbatch slurm/train.sh configs/base.yaml" in done.stderr
