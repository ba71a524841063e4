#!/bin/bash
# Runs a sweep on a real Slurm cluster of two nodes on this machine, kills a task and a node, and checks the table.
#
#   tests/cluster/run.sh [PROGRAM]     default: target/release/plenoxel
#
# Needs root and Debian's packages slurm-wlm and munge, which it does not install. It starts munged, slurmctld and two slurmd with a configuration of their own
# in a temporary folder, and stops them at the end.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
program=$(realpath "${1:-$here/../../target/release/plenoxel}")
for needed in munged slurmctld slurmd sbatch squeue scancel; do
    command -v $needed > /dev/null || { echo "$needed is missing: install the packages slurm-wlm and munge"; exit 1; }
done
work=$(mktemp -d)
export SLURM_CONF=$work/slurm.conf
cleanup() {
    scancel --user="$(id -un)" 2> /dev/null || true
    for pid in "$work"/*.pid; do [ -e "$pid" ] && kill "$(cat "$pid")" 2> /dev/null || true; done
    sleep 1
    rm -rf "$work"
}
trap cleanup EXIT

# Munge wants its files to belong to its user, and folders that no group writes.
chmod 755 "$work"
mkdir -m 755 "$work/munge" "$work/state" "$work/spool"
(umask 077; head -c 1024 /dev/urandom > "$work/munge/key")
socket=$work/munge/socket
munged --key-file="$work/munge/key" --socket="$socket" --pid-file="$work/munged.pid" --log-file="$work/munge/log" --seed-file="$work/munge/seed" --force
host=$(hostname -s)
cat > "$SLURM_CONF" <<C
ClusterName=test
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket=$socket
CredType=cred/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
MpiDefault=none
ReturnToService=2
SlurmdTimeout=10
KillWait=10
MinJobAge=300
StateSaveLocation=$work/state
SlurmdSpoolDir=$work/spool/%n
SlurmctldPidFile=$work/slurmctld.pid
SlurmdPidFile=$work/slurmd-%n.pid
SlurmctldLogFile=$work/slurmctld.log
SlurmdLogFile=$work/slurmd-%n.log
SlurmctldPort=16817
NodeName=n1 NodeHostname=$host NodeAddr=127.0.0.1 Port=16819 CPUs=1 RealMemory=4000 State=UNKNOWN
NodeName=n2 NodeHostname=$host NodeAddr=127.0.0.1 Port=16820 CPUs=1 RealMemory=4000 State=UNKNOWN
PartitionName=all Nodes=n1,n2 Default=YES MaxTime=INFINITE State=UP
C
slurmctld
slurmd -N n1
slurmd -N n2
for _ in $(seq 30); do [ "$(sinfo --noheader --format=%T:%D 2> /dev/null)" = idle:2 ] && break; sleep 1; done
sinfo

cd "$work"
cp "$here/sweep.toml" .
sweep() { "$program" sweep sweep.toml --threads 1 "$@"; }
# Waits until Slurm has no jobs.
ended() { while [ -n "$(squeue --noheader)" ]; do sleep 0.5; done; }
# Columns of the table that do not depend on the machine: scene, method, PSNR.
results() { python3 -c "
import csv, sys
for row in csv.DictReader(open(sys.argv[1])): print(*list(row.values())[:2], row['psnr'])" "$1/table.csv"; }
timed() { local start=$(date +%s.%N); "$@"; ended; echo "$(date +%s.%N) - $start" | bc; }

echo "local, one after another"; start=$(date +%s); sweep --out local > /dev/null 2>&1; echo "$(($(date +%s) - start)) s"
results local > expected
for slots in 1 2; do
    start=$(date +%s.%N)
    sweep --engine slurm --jobs $slots --out slots-$slots
    # Nothing is submitted twice.
    if sweep --engine slurm --out slots-$slots 2> refused; then echo "FAILED: submitted twice"; exit 1; fi
    grep -q "Slurm still has" refused
    ended
    python3 -c "print('$slots slots: %.1f s' % ($(date +%s.%N) - $start))"
    results slots-$slots | diff expected - && echo "the table is equal to the local one"
done

echo "kills"
sweep --engine slurm --out killed
until pgrep -f 'train.*killed/few/long' > /dev/null; do sleep 0.2; done
sweep --out killed --status
sleep 1
# A run is killed: its task fails.
pkill -KILL -f -- '--out killed/few/long'
# A node vanishes: Slurm requeues its task on the other one.
until pgrep -f 'train.*killed/many' > /dev/null; do sleep 0.2; done
node=$(squeue --noheader --states=running --format=%N | head -1)
kill -KILL "$(cat "$work/slurmd-$node.pid")"
pkill -KILL -f "slurmstepd" || true
echo "node $node is gone"
sleep 15
sweep --out killed --status
slurmd -N "$node"
ended
sweep --out killed --status
# What failed is made again.
sweep --engine slurm --out killed
ended
results killed | diff expected - && echo "the table is equal to the local one after the kills"
