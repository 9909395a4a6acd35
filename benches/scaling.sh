#!/usr/bin/env bash
# Times one picture by 1 to 8 real workers, each a process of one thread that gets 15 % of a processor:
# benches/scaling.sh RTFARM [SCENE SIZE SAMPLES]. Needs root, for control groups.
set -euo pipefail
rtfarm=$1 scene=${2:-scenes/gnome.rt} size=${3:-480x360} samples=${4:-8}
groups=/sys/fs/cgroup
[ -e $groups/cgroup.controllers ] || groups=$groups/cpu
folder=$(mktemp -d)
mkdir "$groups/rtfarm"
[ ! -e "$groups/cgroup.subtree_control" ] || echo +cpu >"$groups/rtfarm/cgroup.subtree_control"
clean() {
    kill $(jobs -p) 2>/dev/null || true
    wait
    rmdir "$groups"/rtfarm/*/ "$groups/rtfarm"
    rm -r "$folder"
}
trap clean EXIT

# Becomes what follows, in a group that gets 1.5 ms of each 10 ms.
limited() {
    local group=$groups/rtfarm/$1
    mkdir -p "$group"
    if [ -e "$group/cpu.max" ]; then
        echo 1500 10000 >"$group/cpu.max"
    else
        echo 10000 >"$group/cpu.cfs_period_us"
        echo 1500 >"$group/cpu.cfs_quota_us"
    fi
    echo $BASHPID >"$group/cgroup.procs"
    exec "${@:2}"
}

"$rtfarm" coordinator --listen 127.0.0.1:7979 >/dev/null 2>&1 &
sleep 0.3
for count in 1 2 3 4 6 8; do
    workers=()
    for worker in $(seq $count); do
        limited $worker "$rtfarm" worker --coordinator http://127.0.0.1:7979 --threads 1 2>/dev/null &
        workers+=($!)
    done
    sleep 1.5
    "$rtfarm" submit "$scene" --coordinator http://127.0.0.1:7979 --size "$size" --samples "$samples" \
        -o "$folder/out.png" --json 2>/dev/null |
        sed -n "s/^ *\"seconds\": \(.*\),/$count workers: \1 s/p"
    kill "${workers[@]}"
    wait "${workers[@]}" || true
done
