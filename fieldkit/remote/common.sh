#!/bin/sh
# Detached jobs on a robot. fieldkit installs this file once and calls it for every long command, so that a
# lost connection ends nothing and every process can be ended by its recorded identity.
#
#   job.sh start DIR NAME LIMIT READY WITHIN IN OUT LOG ARGV...
#                                        start in DIR, return when READY holds; not up WITHIN seconds, it is killed
#   job.sh run   DIR NAME LIMIT READY WITHIN IN OUT LOG ARGV...
#                                        start, return with the job's exit code when it and standard input ended, or
#                                        some seconds after its LIMIT
#   job.sh serve DIR NAME LIMIT READY WITHIN IN OUT LOG ARGV...
#                                        start, say `up`, return with the job's exit code when it ended
#   job.sh wait  DIR NAME SECONDS        return when the job has ended: its exit code, 137 if killed, or 124
#   job.sh stop  DIR NAME SIGNAL GRACE FILE [LOG TEXT]
#                                        let FILE stop growing (`-`: none), signal the group, after GRACE seconds kill
#                                        it; return once LOG contains TEXT, and leave it to `pack` to see it end
#   job.sh begin DIR ROLE INTERFACE KIB TOKEN [OLD]
#                                        remove OLD, renew the lock (TOKEN `-`: none), demand KIB of free disk,
#                                        make DIR, write the host's state to ROLE-before.txt, begin to sample its Wi-Fi
#                                        into ROLE-link.txt, by the job `link`
#   job.sh pack  DIR ROLE INTERFACE      end that, write ROLE-after.txt and sums, send small files as a tar, sums first, with a
#                                        list of the large ones; fail then if a job that `stop` let go did not end well
#   job.sh piece DIR FILE NUMBER BYTES   send a piece of FILE, pieces counted from 0
#   job.sh sum   DIR FILE                tell the sum of FILE
#   job.sh end   DIR                     end every job of DIR that still runs; no other starts there
#   job.sh drop  DIR                     remove DIR, and the folder that it is in where nothing else is
#   job.sh tidy  DIR NAME...             remove the folders in DIR but for these
#   job.sh left                          list jobs that still run, of any trial: DIR/NAME PID COMMAND, DIR below the home;
#                                        and processes in folders that were removed
#   job.sh lock TOKEN SECONDS WHO WHAT   take this robot, or take it again
#   job.sh renew TOKEN SECONDS           hold it for so many seconds more at least; fail if it is somebody else's or nobody's
#   job.sh unlock TOKEN                  give it back
#   job.sh holder                        tell who holds it, if anybody: TOKEN SECONDS WHO WHAT, expiring in SECONDS
#   job.sh abort WHO                     break the lock, say `held WHO WHAT` or `free`, end every job of any trial and list it
#                                        as `left` does; needs no file of its own and no room; then list the programs that
#                                        still bring a drone down: `lands DIR/.jobs/NAME STATE`, as `motion_states`
#   job.sh halt_motion WHO [DIR]         stop every program of the agent that drives or flies this robot, or watches a drone,
#                                        and what holds the robot's lock; with DIR those of DIR alone, and leave the lock;
#                                        then list them: DIR/.jobs/NAME STATE, as `motion_states`
#   job.sh motion_states DIR/.jobs/NAME...
#                                        list the states: `stationary`, `landed`, `land` or `return` (coming down), `ended`,
#                                        `silent`, or `alarm` (a drone that may be in the air)
#   job.sh life_signs FILE               print FILE and the time since boot
#   job.sh needs                         fail if a program is missing that this script calls
#   job.sh stand                         say `ready`; then run each line of standard input, `NONCE [held] VERB WORD...`,
#                                        as if it were called so: NONCE goes before what a verb prints, NONCE and its exit
#                                        code come behind it, on both streams; with `held` once another line is there
#
# Each may be repeated when its answer was lost: a job that exists is joined, not started again.
# READY is `-` (none), `log:TEXT` (LOG contains TEXT), `tcp:PORT` or `udp:PORT` (bound, PORT in hex).
# LIMIT counts from when READY holds, or from WITHIN seconds after the start.
# DIR is below the home; IN, OUT and LOG are files in it.
# A job lives in DIR/.jobs/NAME: command, pid ("PID STARTTIME BOOT"), exit; DIR/.began has TOKEN and boot of `begin`.
# A start renews the lock for as long as the job may take. What fails says `job.sh: ` and why.
set -u
umask 022
case $0 in /*) self=$0 ;; *) self=$PWD/$0 ;; esac
base=${self%/*}

GENERAL=125 DISK=28 HELD=75 LOST=76 REBOOTED=77

fail() { # say why, and end with a code of its own
    echo "job.sh: $1" >&2
    exit "${2-$GENERAL}"
}

needs() {
    for program in setsid mkfifo timeout cat tail awk grep date df ln ls sync tar tr wc dd sha256sum; do
        command -v "$program" >/dev/null || missing="${missing-} $program"
    done
    [ -z "${missing-}" ] || fail "it lacks$missing"
}

# On a small computer a fork takes milliseconds, so what a shell can do by itself it does by itself.
clock() { # set now to seconds since boot
    read -r now _ </proc/uptime && now=${now%.*}
}

nap() { # a sleep that knows whole seconds only rounds up
    sleep "$1" 2>/dev/null || [ $? -gt 128 ] || sleep $((${1%.*} + 1))
}

lasting() { # write files and folders $@ to the disk
    # There was a sync that knows no names, and writes all that there is.
    sync "$@" 2>/dev/null || sync
}

identify() { # set identity to "PID STARTTIME BOOT" of process $1; a zombie (Z) has ended, also while it is reaped (X)
    identity=
    read -r stat 2>/dev/null <"/proc/$1/stat" && read -r boot </proc/sys/kernel/random/boot_id || return 1
    pid_of=$1
    set -- ${stat##*) }
    case $1 in [ZX]) return 1 ;; esac
    identity="$pid_of ${20} $boot" # field 22 of stat, in clock ticks since boot
}

alive() { # whether the job in $1 runs; sets pid
    read -r recorded 2>/dev/null <"$1/pid" && pid=${recorded%% *} && identify "$pid" && [ "$identity" = "$recorded" ]
}

ended() { # whether the job in $1 was up and is no more
    [ -s "$1/exit" ] || { [ -s "$1/pid" ] && ! alive "$1"; }
}

result() { # of an ended job; one that was killed left no exit code
    [ -s "$1/exit" ] && read -r code <"$1/exit" && return "$code"
    rebooted "$1" && fail "job ${1##*/} was cut: the robot rebooted" "$REBOOTED"
    [ -e "$1/pid" ] || fail "no job in $1"
    return 137
}

rebooted() { # whether the robot did since the job in $1 was started or, where no record of that is left, its folder made
    began=
    read -r boot </proc/sys/kernel/random/boot_id
    read -r began 2>/dev/null <"$1/pid"
    [ -n "$began" ] || read -r began 2>/dev/null <"${1%/.jobs/*}/.began"
    [ -n "$began" ] && [ "${began##* }" != "$boot" ]
}

enter() { # folder $1
    cd "$1" 2>/dev/null && return
    clock
    [ "$now" -gt "$TTL" ] || fail "no folder $1: the robot booted $now s ago" "$REBOOTED"
    fail "no folder $1"
}
