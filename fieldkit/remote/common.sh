#!/bin/sh
# The job script, which runs detached jobs on a robot. fieldkit installs it once, as one file that is joined from the .sh
# files of this folder (script.py), and calls it for each long command. A job therefore continues after a lost connection,
# and can be stopped by the recorded identity of its process.
#
#   job.sh start DIR NAME LIMIT READY WITHIN IN OUT LOG ARGV...
#                                        start a job in DIR, return when it is READY; kill it if it is not ready after
#                                        WITHIN seconds
#   job.sh run   DIR NAME LIMIT READY WITHIN IN OUT LOG ARGV...
#                                        start a job, return its exit code after the end of the job and of standard input,
#                                        or some seconds after LIMIT
#   job.sh serve DIR NAME LIMIT READY WITHIN IN OUT LOG ARGV...
#                                        start a job, print `up` when it is ready, return its exit code after its end
#   job.sh wait  DIR NAME SECONDS        return when the job has ended: its exit code, 137 if killed, or 124 (timeout)
#   job.sh stop  DIR NAME SIGNAL GRACE FILE [LOG TEXT]
#                                        wait until FILE stops growing (`-`: none), send SIGNAL to the process group, and
#                                        SIGKILL after GRACE seconds; with TEXT return when LOG contains it, and let `pack`
#                                        wait for the end
#   job.sh begin DIR ROLE INTERFACE KIB TOKEN [OLD [SOURCE...]]
#                                        delete OLD, renew the lock (TOKEN `-`: none), check for KIB of free disk space,
#                                        create DIR, write the state of the host to ROLE-before.txt and a snapshot to
#                                        ROLE-sources-before.txt, and start the job `link`, which samples the Wi-Fi
#                                        into ROLE-link.txt, the job `clock`, which reports on the clock in
#                                        ROLE-sources-during.txt, and a job for each SOURCE
#   job.sh poll FILE TOKEN ADDRESS INTERFACE INTERVAL LIMIT ARGV...
#                                        run ARGV at intervals and print its output, see telemetry.sh
#   job.sh pack  DIR ROLE INTERFACE      stop the jobs that `begin` started, write ROLE-after.txt, ROLE-sources-after.txt and
#                                        hashes, send small files as a tar: first the hashes and the list of large files;
#                                        then fail if a job for which `stop` did not wait has failed
#   job.sh piece DIR FILE NUMBER BYTES   send a piece of FILE; pieces are counted from 0
#   job.sh sum   DIR FILE                print the hash of FILE
#   job.sh end   DIR                     stop all running jobs of DIR; no other job can start there
#   job.sh halt  DIR                     stop all running jobs in all folders in DIR
#   job.sh drop  DIR                     delete DIR, and its parent folder if it is empty
#   job.sh tidy  DIR NAME...             delete all folders in DIR except the folders NAME...
#   job.sh left                          list running jobs of all trials: DIR/NAME PID COMMAND, DIR below the home; and
#                                        processes whose working folder was deleted
#   job.sh lock TOKEN SECONDS WHO WHAT   lock this robot; idempotent
#   job.sh renew TOKEN SECONDS           extend the lock to at least SECONDS from now; fail if it is not the lock of TOKEN;
#                                        create it if the robot has no record of a lock
#   job.sh unlock TOKEN                  release the lock
#   job.sh holder                        print the record of the lock, if any: TOKEN SECONDS WHO WHAT; it expires in SECONDS
#   job.sh abort WHO                     break the lock, print `held WHO WHAT` or `free`, stop all jobs of all trials and list
#                                        them as `left` does; needs no installed script and no free disk space; then list the
#                                        programs that still land a drone: `lands DIR/.jobs/NAME STATE`, as `motion_states`
#   job.sh halt_motion WHO [DIR]         stop all programs of the agent (fieldkit's Python program on robots) that drive or
#                                        fly this robot, or guard a drone, and the trial that holds the lock; with DIR only
#                                        the programs of DIR, without the lock; then list them: DIR/.jobs/NAME STATE, as
#                                        `motion_states`
#   job.sh motion_states DIR/.jobs/NAME...
#                                        list the states: `idle`, `stationary`, `landed`, `land` or `return` (in progress),
#                                        `ended`, `silent`, or `alarm` (a drone may be in the air)
#   job.sh life_signs FILE               print FILE and the time since boot
#   job.sh snapshot                      print the outputs of all sources of the robot's state, see `snapshot.sh`
#   job.sh sample INTERFACE TOKEN        print the state of the Wi-Fi link until it is stopped, see telemetry.sh
#   job.sh sample_clock TOKEN SECONDS    print the state of the clock at intervals until it is stopped, see snapshot.sh
#   job.sh health                        print the load, temperatures, batteries and free disk space of this computer
#   job.sh needs                         fail if a program is missing that this script calls
#   job.sh command_loop                  print `ready`; then run each line of standard input, `NONCE [held] VERB WORD...`, as
#                                        if the script was called with it. On both streams NONCE precedes the output, and
#                                        NONCE and the exit code follow it; with `held` only after another line was read
#
# All verbs are idempotent, so that a call can be repeated if its answer was lost: an existing job is not started again.
# READY is the condition for a job to be ready: `-` (none), `log:TEXT` (LOG contains TEXT), `tcp:PORT` or `udp:PORT` (a
# socket is bound to PORT, in hex). LIMIT starts when the job is ready, or WITHIN seconds after its start.
# DIR is below the home; IN, OUT and LOG are files in it. WHO is the user, as USER@HOST; WHAT is the trial.
# The files of a job are in DIR/.jobs/NAME: command, pid ("PID STARTTIME BOOT"), exit. DIR/.began has TOKEN and boot ID.
# `start`, `run` and `serve` renew the lock for the maximum duration of the job. Error messages begin with `job.sh: `.
set -u
umask 022
case $0 in /*) self=$0 ;; *) self=$PWD/$0 ;; esac
base=${self%/*}

# Exit codes: other error, disk full, locked by another trial, lock of this trial lost, robot rebooted.
GENERAL=125 DISK=28 HELD=75 LOST=76 REBOOTED=77

fail() { # print message $1 and exit with code $2
    echo "job.sh: $1" >&2
    exit "${2-$GENERAL}"
}

needs() {
    for program in setsid mkfifo timeout cat tail awk grep date df ln ls sync tar tr wc dd sha256sum; do
        command -v "$program" >/dev/null || missing="${missing-} $program"
    done
    [ -z "${missing-}" ] || fail "it lacks$missing"
}

# On a small computer a fork takes milliseconds, so the script prefers builtin commands of the shell to programs.
read_uptime() { # set now to the seconds since boot
    read -r now _ </proc/uptime && now=${now%.*}
}

# Sleep for $1 seconds, rounded up if `sleep` supports whole seconds only. An exit code above 128 means that a signal ended
# the sleep.
sleep_for() {
    sleep "$1" 2>/dev/null || [ $? -gt 128 ] || sleep $((${1%.*} + 1))
}

sleep_before_poll() { # sleep for 2 ms before each of the first 10 polls, and for 20 ms later, to save processor time
    polls=$((polls + 1))
    if [ "$polls" -le 10 ]; then sleep_for 0.002; else sleep_for 0.02; fi
}

sync_to_disk() { # flush files and folders $@ to the disk
    # Old versions of sync accept no names, and flush everything.
    sync "$@" 2>/dev/null || sync
}

identify() { # set identity to "PID STARTTIME BOOT" of process $1; false for a zombie (Z) and a dead process (X)
    identity=
    read -r stat 2>/dev/null <"/proc/$1/stat" && read -r boot </proc/sys/kernel/random/boot_id || return 1
    pid_of=$1
    set -- ${stat##*) }
    case $1 in [ZX]) return 1 ;; esac
    identity="$pid_of ${20} $boot" # field 22 of stat, in clock ticks since boot
}

alive() { # true if the job in $1 runs; sets pid
    read -r recorded 2>/dev/null <"$1/pid" && pid=${recorded%% *} && identify "$pid" && [ "$identity" = "$recorded" ]
}

ended() { # true if the job in $1 was started and has ended
    [ -s "$1/exit" ] || { [ -s "$1/pid" ] && ! alive "$1"; }
}

result() { # return the exit code of the job in $1, which has ended; 137 if a killed job wrote none
    [ -s "$1/exit" ] && read -r code <"$1/exit" && return "$code"
    rebooted "$1" && fail "job ${1##*/} was interrupted: the robot rebooted" "$REBOOTED"
    [ -e "$1/pid" ] || fail "no job in $1"
    return 137
}

rebooted() { # true if the robot has rebooted since the start of the job in $1 or, if its start was not recorded, since `begin`
    began=
    read -r boot </proc/sys/kernel/random/boot_id
    read -r began 2>/dev/null <"$1/pid"
    [ -n "$began" ] || read -r began 2>/dev/null <"${1%/.jobs/*}/.began"
    [ -n "$began" ] && [ "${began##* }" != "$boot" ]
}

enter() { # change to folder $1
    cd "$1" 2>/dev/null && return
    read_uptime
    # In the first TTL seconds (an hour) after a boot, the reboot is the probable cause.
    [ "$now" -gt "$TTL" ] || fail "no folder $1: the robot booted $now s ago" "$REBOOTED"
    fail "no folder $1"
}
