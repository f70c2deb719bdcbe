#!/bin/sh
# A sequence on a Slurm of one node, as docs/FARM.md describes it: a job array over 24 frames, one task of it killed and put back into the queue,
# and every file byte for byte that of a serial run. Installs slurm-wlm where it is missing; needs root for Slurm's daemons.
set -eu
cd "$(dirname "$0")/../.."
command -v sbatch >/dev/null && command -v slurmctld >/dev/null ||
    apt-get install -y --no-install-recommends slurm-wlm munge >/dev/null
cargo build --release --locked --bin vdb-edit
tool=$PWD/target/release/vdb-edit
recipe=$PWD/tests/farm/sequence.toml
place=$(mktemp -d)
daemons=
finish() {
    for pid in $daemons; do kill "$pid" 2>/dev/null || true; done
    rm -rf "$place"
}
trap finish EXIT INT TERM
mkdir "$place/serial" "$place/farm" "$place/state" "$place/spool"

echo 'serial run'
"$tool" run "$recipe" --frames 1-24 -o "$place/serial" --quiet

host=$(hostname -s)
cat >"$place/slurm.conf" <<EOF
ClusterName=one
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=16817
SlurmdPort=16818
AuthType=auth/none
CredType=cred/none
SlurmUser=root
StateSaveLocation=$place/state
SlurmdSpoolDir=$place/spool
SlurmctldPidFile=$place/slurmctld.pid
SlurmdPidFile=$place/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
ReturnToService=2
JobRequeue=1
MinJobAge=600
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(nproc)
PartitionName=all Nodes=$host Default=YES State=UP
EOF
export SLURM_CONF="$place/slurm.conf"
slurmctld -D 2>"$place/slurmctld.log" &
daemons="$daemons $!"
slurmd -D 2>"$place/slurmd.log" &
daemons="$daemons $!"
tries=0
until sinfo -h -o %T 2>/dev/null | grep -q idle; do
    tries=$((tries + 1))
    [ $tries -lt 60 ] || { cat "$place/slurmctld.log" "$place/slurmd.log"; echo 'Slurm did not start'; exit 1; }
    sleep 1
done

cat >"$place/frames.sbatch" <<EOF
#!/bin/sh
#SBATCH --array=1-24
#SBATCH --cpus-per-task=1
#SBATCH --requeue
#SBATCH --output=$place/task-%a.log
"$tool" run "$recipe" --frames "\$SLURM_ARRAY_TASK_ID" --skip-existing --threads "\$SLURM_CPUS_PER_TASK" -o "$place/farm" --log-format json
EOF
job=$(sbatch --parsable "$place/frames.sbatch")
echo "job $job"
tries=0
until squeue -h -r -t RUNNING -o %K -j "$job" | grep -q .; do
    tries=$((tries + 1))
    [ $tries -lt 60 ] || { echo 'no task runs'; exit 1; }
    sleep 0.2
done
task=$(squeue -h -r -t RUNNING -o %K -j "$job" | head -n 1)
scontrol requeue "${job}_$task"
echo "task $task was killed and put back"
tries=0
while squeue -h -j "$job" | grep -q .; do
    tries=$((tries + 1))
    [ $tries -lt 600 ] || { squeue; echo 'the job does not end'; exit 1; }
    sleep 1
done

for frame in "$place"/serial/frame.*.vdb; do
    cmp "$frame" "$place/farm/$(basename "$frame")"
done
[ "$(ls -A "$place/farm" | wc -l)" = 24 ]
echo 'all 24 frames are byte for byte those of the serial run'
