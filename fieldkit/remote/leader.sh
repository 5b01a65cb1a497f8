# The leader of a job's own session and process group. It comes before the other parts, and ends the shell: eight jobs
# of a repeat have one each, and to read the rest would take each half a millisecond.

bound() { # protocol and port in hex; a TCP listener has state 0A
    if [ "$1" = tcp ] && listening=$(ss -tn state listening "sport = :$((0x$2))" 2>/dev/null); then
        # It asks for listeners alone; a kernel may take 4 ms to go through each table of all connections.
        case $listening in *":$((0x$2)) "*) return ;; *) return 1 ;; esac
    fi
    case $1 in tcp) state=0A ;; *) state=07 ;; esac
    grep -qsE "^ *[0-9]+: [0-9A-F]+:$2 [0-9A-F]+:0000 $state " "/proc/net/$1" "/proc/net/${1}6"
}

holds() { # whether file $1 has a line with $2
    [ -e "$1" ] || return 1
    while read -r line || [ -n "$line" ]; do
        case $line in *"$2"*) return 0 ;; esac
    done <"$1"
    return 1
}

ready() {
    case $1 in
        -) true ;;
        log:*) holds "$2" "${1#log:}" ;;
        *) bound "${1%%:*}" "${1#*:}" ;;
    esac
}

supervise() { # leader of the job's own session and process group; $1 is the shell that it ends to be detached, or -
    shell=$1 meta=$2 limit=$3 ready=$4 within=$5 in=$6 out=$7 log=$8
    shift 8
    trap : INT TERM HUP
    [ "$shell" != "$PPID" ] || kill -KILL "$shell"
    mkfifo "$meta/end" && exec 9<>"$meta/end" # open as long as the job lives: who waits for it meets its end
    { identify $$ && echo "$identity" >"$meta/pid"; } || exit "$GENERAL" # nobody could end it
    # Who ends all jobs says so before it looks for them: one of the two sees the other.
    [ ! -e "${meta%/.jobs/*}/.ended" ] || exit "$GENERAL"
    # A signal that came before this child had its own traps is lost; the exit code then lies there already, or, where
    # the folder was removed since, the leader is gone.
    (trap - INT TERM HUP
        [ -s "$meta/exit" ] || ! kill -0 $$ 2>/dev/null || { await_ready; nap "$limit"; printf '' >"$meta/limit"; kill -INT 0; sleep 5; kill -KILL 0; }) \
        </dev/null >/dev/null 2>&1 9>&- &
    if [ "$out" = "$log" ]; then "$@" <"$in" >"$log" 2>&1 9>&-; else "$@" <"$in" >"$out" 2>"$log" 9>&-; fi
    code=$?
    read -r up _ </proc/uptime && echo "$up" >"$meta/ended"
    echo "$code" >"$meta/exit"
    kill -TERM 0 # the watchdog, and whatever the command left behind
    exit "$code"
}

await_ready() { # until what is ready holds, or $within seconds have passed
    [ "$ready" != - ] || return
    clock
    until_s=$((now + within))
    # At leisure: a kernel may take 4 ms to go through its table of sockets.
    while nap 0.2 && clock && [ "$now" -le "$until_s" ]; do
        ready "$ready" "$log" && return
    done
}

if [ "${1-}" = supervise ]; then
    shift
    supervise "$@"
fi
