#!/bin/sh
# Detached jobs on a robot. fieldkit installs this file once and calls it for every long command, so that a
# lost connection ends nothing and every process can be ended by its recorded identity.
#
#   job.sh start DIR NAME LIMIT READY IN OUT LOG ARGV...
#                                        start in DIR, return when READY holds
#   job.sh run   DIR NAME LIMIT READY IN OUT LOG ARGV...
#                                        start, return with the job's exit code when it and standard input ended
#   job.sh wait  DIR NAME SECONDS        return when the job has ended: its exit code, 137 if killed, or 124
#   job.sh stop  DIR NAME SIGNAL GRACE [FILE]
#                                        let FILE stop growing, signal the group, after GRACE seconds kill it
#   job.sh begin DIR ROLE INTERFACE [OLD]
#                                        make DIR, remove OLD, write the host's state to ROLE-before.txt
#   job.sh pack  DIR ROLE INTERFACE      write ROLE-after.txt and .sums, send all files as a tar
#   job.sh end   DIR                     end every job of DIR that still runs
#   job.sh left                          list jobs that still run: DIR/NAME PID COMMAND
#
# READY is `-` (none), `log:TEXT` (LOG contains TEXT), `tcp:PORT` or `udp:PORT` (bound, PORT in hex).
# DIR is below the home; IN, OUT and LOG are files in it.
# A job lives in DIR/.jobs/NAME: command, pid ("PID STARTTIME BOOT"), exit. POSIX sh, setsid and flock.
set -u
umask 022
case $0 in /*) self=$0 ;; *) self=$PWD/$0 ;; esac

fail() { echo "job.sh: $1" >&2; exit 125; }

# On a small computer a fork takes milliseconds, so what a shell can do by itself it does by itself.
identify() { # set identity to "PID STARTTIME BOOT" of process $1; a zombie has ended
    identity=
    read -r stat 2>/dev/null <"/proc/$1/stat" && read -r boot </proc/sys/kernel/random/boot_id || return 1
    pid_of=$1
    set -- ${stat##*) }
    [ "$1" != Z ] && identity="$pid_of ${20} $boot" # field 22 of stat, in clock ticks since boot
}

alive() { # whether the job in $1 runs; sets pid
    read -r recorded 2>/dev/null <"$1/pid" && pid=${recorded%% *} && identify "$pid" && [ "$identity" = "$recorded" ]
}

result() { # of an ended job; one that was killed left no exit code
    [ -e "$1/pid" ] || fail "no job in $1"
    [ -s "$1/exit" ] || return 137
    read -r code <"$1/exit" && return "$code"
}

bound() { # protocol and port in hex; a TCP listener has state 0A
    case $1 in tcp) state=0A ;; *) state=07 ;; esac
    grep -qsE "^ *[0-9]+: [0-9A-F]+:$2 [0-9A-F]+:0000 $state " "/proc/net/$1" "/proc/net/${1}6"
}

ready() {
    case $1 in
        -) true ;;
        log:*) grep -qsF -- "${1#log:}" "$2" ;;
        *) bound "${1%%:*}" "${1#*:}" ;;
    esac
}

launch() { # $1 is start or run
    how=$1 dir=$2 name=$3 limit=$4 ready=$5 in=$6 out=$7 log=$8
    shift 8
    cd "$dir" 2>/dev/null || fail "no folder $dir"
    meta=$PWD/.jobs/$name
    mkdir "$meta" 2>/dev/null || fail "job $name was started before, or its folder was not begun"
    printf '%s\n' "$*" >"$meta/command"
    # setsid -f forks by itself: a job started with & would ignore SIGINT for ever.
    if [ "$how" = run ]; then
        setsid -f -w sh "$self" supervise "$meta" "$limit" "$in" "$out" "$log" "$@" </dev/null
        code=$?
        while read -r _; do :; done # the caller closes standard input when it wants to be told
        exit "$code"
    fi
    setsid -f sh "$self" supervise "$meta" "$limit" "$in" "$out" "$log" "$@" </dev/null >/dev/null 2>&1
    until [ -s "$meta/pid" ] && ready "$ready" "$log"; do
        if [ -s "$meta/exit" ]; then
            tail -n 3 "$log" >&2
            fail "job $name ended before it was ready"
        fi
        sleep 0.002
    done
}

supervise() { # leader of the job's own session and process group
    meta=$1 limit=$2 in=$3 out=$4 log=$5
    shift 5
    trap : INT TERM HUP
    exec 9>"$meta/lock" && flock 9 # held as long as the job lives: wait blocks on it, without polling
    identify $$ && echo "$identity" >"$meta/pid"
    (sleep "$limit"; kill -s INT 0; sleep 5; kill -s KILL 0) </dev/null >/dev/null 2>&1 9>&- &
    if [ "$out" = "$log" ]; then "$@" <"$in" >"$log" 2>&1 9>&-; else "$@" <"$in" >"$out" 2>"$log" 9>&-; fi
    code=$?
    echo "$code" >"$meta/exit"
    kill -s TERM 0 # the watchdog, and whatever the command left behind
    exit "$code"
}

await() { # the end of the job in $1, for $2 seconds at most: its supervisor holds the lock as long as it lives
    [ -e "$1/pid" ] || fail "no job in $1"
    flock -w "$2" "$1/lock" true
}

settle() { # wait until file $1 has not grown for 20 ms, 2 s at most
    n=0 last=-1
    while size=$(wc -c <"$1") && [ "$size" != "$last" ] && [ "$n" -lt 100 ]; do
        last=$size n=$((n + 1))
        sleep 0.02
    done
}

stop() {
    meta=$1/.jobs/$2
    [ -z "${5-}" ] || settle "$1/$5"
    if alive "$meta" && [ ! -s "$meta/exit" ]; then
        kill -s "$3" -- "-$pid" || ! alive "$meta" || fail "cannot signal the group $pid"
        await "$meta" "$4" || kill -s KILL -- "-$pid"
    fi
    result "$meta"
}

state() { # $1 interface
    date -u '+==> date <==%n%s.%N'
    tail -n +1 /proc/net/snmp /proc/net/netstat /proc/net/dev /proc/net/wireless /proc/loadavg
    echo "==> ip -s link <==" && ip -s link show dev "$1"
    command -v ethtool >/dev/null && echo "==> ethtool -k <==" && ethtool -k "$1"
    command -v iw >/dev/null && echo "==> iw station dump <==" && iw dev "$1" station dump
    return 0
}

left() {
    for meta in "$HOME"/.fieldkit/*/*/.jobs/*; do
        alive "$meta" && echo "$meta $pid $(cat "$meta/command")"
    done
    return 0
}

verb=${1-}
[ $# -gt 0 ] && shift
case $verb in
    start | run) launch "$verb" "$@" ;;
    supervise) supervise "$@" ;;
    wait) await "$1/.jobs/$2" "$3" || exit 124; result "$1/.jobs/$2" ;;
    stop) stop "$@" ;;
    begin) [ -z "${4-}" ] || rm -rf -- "$4"; mkdir -p "$1/.jobs" && cd "$1" && state "$3" >"$2-before.txt" 2>&1 ;;
    pack) cd "$1" && state "$3" >"$2-after.txt" 2>&1; sha256sum -- * >.sums && tar -cf - -- .sums * ;;
    end) for meta in "$1"/.jobs/*; do [ -e "$meta/pid" ] && stop "$1" "${meta##*/}" INT 2; done; true ;;
    left) left ;;
    *) fail "unknown verb '$verb'" ;;
esac
