# The leader of the session and process group of a job. This part is before the larger parts of the script, and exits after
# the job: parsing the other parts would take half a millisecond for each of up to eight jobs of a repeat.

is_bound() { # true if a socket is bound; $1 protocol, $2 port in hex; a TCP listener has state 0A, a UDP socket 07
    if [ "$1" = tcp ] && listening=$(ss -tn state listening "sport = :$((0x$2))" 2>/dev/null); then
        # ss requests listeners only; reading a table of all connections takes up to 4 ms.
        case $listening in *":$((0x$2)) "*) return ;; *) return 1 ;; esac
    fi
    case $1 in tcp) state=0A ;; *) state=07 ;; esac
    grep -qsE "^ *[0-9]+: [0-9A-F]+:$2 [0-9A-F]+:0000 $state " "/proc/net/$1" "/proc/net/${1}6"
}

has_line_with() { # true if file $1 has a line that contains $2
    [ -e "$1" ] || return 1
    while read -r line || [ -n "$line" ]; do
        case $line in *"$2"*) return 0 ;; esac
    done <"$1"
    return 1
}

is_ready() { # true if condition $1 (READY in common.sh) is met; $2 log of the job
    case $1 in
        -) true ;;
        log:*) has_line_with "$2" "${1#log:}" ;;
        *) is_bound "${1%%:*}" "${1#*:}" ;;
    esac
}

supervise() { # run a job as the leader of its session and process group; $1 is the subshell that is killed to detach, or -
    shell=$1 meta=$2 limit=$3 ready=$4 within=$5 in=$6 out=$7 log=$8
    shift 8
    trap : INT TERM HUP
    [ "$shell" != "$PPID" ] || kill -KILL "$shell"
    mkfifo "$meta/end" && exec 9<>"$meta/end" # open until the job ends; a reader then receives end-of-file
    { identify $$ && echo "$identity" >"$meta/pid"; } || exit "$GENERAL" # without a record it could not be stopped
    # `end` writes .ended before it lists the jobs, and this job has written its pid, so one of the two detects the other.
    [ ! -e "${meta%/.jobs/*}/.ended" ] || exit "$GENERAL"
    # This subshell is the watchdog, which stops the job at its time limit. It does not receive the final SIGTERM if the
    # signal arrives before the watchdog has reset its traps. It therefore ends if the exit code was written already or,
    # because the folder may have been deleted, if the leader has exited.
    (trap - INT TERM HUP
        [ -s "$meta/exit" ] || ! kill -0 $$ 2>/dev/null || { await_ready; sleep_for "$limit"; printf '' >"$meta/limit"; kill -INT 0; sleep 5; kill -KILL 0; }) \
        </dev/null >/dev/null 2>&1 9>&- &
    if [ "$out" = "$log" ]; then "$@" <"$in" >"$log" 2>&1 9>&-; else "$@" <"$in" >"$out" 2>"$log" 9>&-; fi
    code=$?
    read -r up _ </proc/uptime && echo "$up" >"$meta/ended"
    echo "$code" >"$meta/exit"
    kill -TERM 0 # the watchdog, and remaining processes of the command
    exit "$code"
}

await_ready() { # wait until the job is ready, or $within seconds have passed
    [ "$ready" != - ] || return
    read_uptime
    until_s=$((now + within))
    # Polled slowly, because reading the table of sockets takes up to 4 ms.
    while sleep_for 0.2 && read_uptime && [ "$now" -le "$until_s" ]; do
        is_ready "$ready" "$log" && return
    done
}

if [ "${1-}" = supervise ]; then
    shift
    supervise "$@"
fi
