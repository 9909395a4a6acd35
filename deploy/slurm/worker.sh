#!/bin/sh
# Workers of a farm, one an array task. `rtfarm render --slurm` hands this very script to sbatch; for a
# farm that stays up:
#
#     sbatch --array=1-8 --cpus-per-task=16 worker.sh PROGRAM ACCESS [OPTIONS]
#
# PROGRAM is rtfarm, ACCESS the access file farm/access/work, both on a disk that the nodes share;
# OPTIONS are those of `rtfarm worker`. Slurm asks a worker to end 30 s before its time is over and when
# it is preempted: it finishes the tiles in hand within --grace. One that was preempted, and one whose
# node has died, is queued again.
#SBATCH --job-name=rtfarm-worker
#SBATCH --array=1-2
#SBATCH --signal=B:TERM@30
#SBATCH --requeue
#SBATCH --open-mode=append
program=$1 access=$2
shift 2
# A shared disk may show a new file only after a while.
tries=0
until [ -s "$access" ] || [ $((tries += 1)) -gt 60 ]; do sleep 1; done
# Of the memory that was asked for, in MB, scenes get three quarters; otherwise the worker finds out.
[ "${SLURM_MEM_PER_NODE:-0}" = 0 ] || set -- --memory "$((SLURM_MEM_PER_NODE * 3 / 4))e-3" "$@"
# glibc keeps what a tile's buffers took for the next tile.
export MALLOC_MMAP_THRESHOLD_=33554432 MALLOC_TRIM_THRESHOLD_=67108864
exec "$program" worker --access "$access" --threads "${SLURM_CPUS_ON_NODE:-1}" --grace 25 "$@"
