"""A stand-in for SLURM's commands, for tests: ``sbatch`` runs the script here and now.

It honours ``#SBATCH --output``, gives the script the variables that SLURM gives, keeps the states
of jobs in the folder ``$SLURM_STANDIN``, and refuses options that it does not know, as SLURM does.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

DIRECTIVES = {"job-name", "output", "time", "ntasks", "requeue"}
JOBS = Path(os.environ["SLURM_STANDIN"])


def sbatch(arguments):
    parsable = arguments[:1] == ["--parsable"]
    script, *rest = arguments[1:] if parsable else arguments
    text = Path(script).read_text()
    if not text.startswith("#!"):
        sys.exit("sbatch: error: This does not look like a batch script.")
    given = dict(re.findall(r"^#SBATCH --([a-z-]+)(?:=(.*))?$", text, re.MULTILINE))
    unknown = set(given) - DIRECTIVES
    if unknown:
        sys.exit(f"sbatch: error: unrecognized option {unknown.pop()}")
    job = 1 + len(list(JOBS.glob("*.state")))
    log = given.get("output", "slurm-%j.out").replace("%j", str(job))
    environment = {**os.environ, "SLURM_JOB_ID": str(job), "SLURM_SUBMIT_DIR": os.getcwd()}
    with open(log, "w") as file:
        status = subprocess.call(
            ["bash", script, *rest], stdout=file, stderr=subprocess.STDOUT, env=environment
        )
    (JOBS / f"{job}.state").write_text("COMPLETED" if status == 0 else f"FAILED {status}")
    print(job if parsable else f"Submitted batch job {job}")


def squeue(arguments):
    (option, job) = arguments
    if option != "--job":
        sys.exit(f"squeue: unrecognized option {option}")
    print(f"JOBID STATE\n{job} {(JOBS / f'{job}.state').read_text()}")


def sinfo(arguments):
    print("PARTITION AVAIL TIMELIMIT NODES STATE NODELIST\nnahuku32 up infinite 1 idle stand-in")


if __name__ == "__main__":
    {"sbatch": sbatch, "squeue": squeue, "sinfo": sinfo}[Path(sys.argv[1]).name](sys.argv[2:])
