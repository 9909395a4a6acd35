#!/bin/sh
# A farm's coordinator as a job:
#
#     sbatch coordinator.sh PROGRAM STATE [OPTIONS]
#
# PROGRAM is rtfarm, STATE the folder of the farm's state, both on a disk that the nodes share; OPTIONS
# are those of `rtfarm coordinator`. STATE/access has the access files for worker.sh and for `rtfarm
# submit`. Queued again, it goes on with its jobs; where that is on another node the access files have
# its new address, where workers and those who submit find it within their --patience.
#SBATCH --job-name=rtfarm-coordinator
#SBATCH --cpus-per-task=1
#SBATCH --signal=B:TERM@30
#SBATCH --requeue
#SBATCH --open-mode=append
program=$1 state=$2
shift 2
exec "$program" coordinator --listen "${RTFARM_LISTEN:-0.0.0.0:7878}" --state "$state" "$@"
