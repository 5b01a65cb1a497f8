# Start, await and stop jobs, which continue if the connection is lost; and call the function of each verb.

launch() { # start a job; $1 is start (return when it is ready), run (return its result) or serve (print `up` when it is ready, then return its result)
    how=$1 dir=$2 name=$3 limit=$4 ready=$5 within=$6 in=$7 out=$8 log=$9
    shift 9
    enter "$dir"
    meta=$PWD/.jobs/$name
    read_uptime
    over_s=$((now + ${limit%.*} + within + 10)) # at this time, a caller that has not requested the result by closing standard input is not connected any more
    if [ -d "$meta" ]; then
        is_new=
    elif [ -e .ended ]; then
        fail_late
    elif renew_for_job && reason=$(mkdir "$meta" 2>&1); then
        is_new=1
        [ -O . ] || give_ownership "$meta"
        printf '%s\n' "$*" >"$meta/command"
        set -- "$meta" "$limit" "$ready" "$within" "$in" "$out" "$log" "$@"
    else
        is_new=
        [ -d "$meta" ] || fail "cannot start job $name: $reason"
    fi
    # is_new is 1 if this call has created the job, and empty if an earlier call has created it.
    case $how$is_new in
        run1)
            setsid sh "$self" supervise - "$@" </dev/null
            code=$?
            [ -s "$meta/pid" ] || fail_to_write "$meta/pid"
            [ -s "$meta/exit" ] || [ ! -e .ended ] || fail_late
            exit_when_requested "$code"
            ;;
        run)
            wait_until_ready
            await "$meta"
            result "$meta"
            exit_when_requested $?
            ;;
        *1) detach "$@" ;;
    esac
    [ "$how" = serve ] || { wait_until_ready; return; }
    # A repeated call for a job that was ready succeeds, even if the job has ended since.
    [ -e "$meta/up" ] || wait_until_ready
    { printf '' >"$meta/up"; } 2>/dev/null
    echo up
    await "$meta" $((${limit%.*} + 10)) || exit 124
    result "$meta"
}

renew_for_job() { # renew the lock under which the folder was created, until a job with this limit has ended
    token=-
    [ ! -s .began ] || read -r token _ <.began
    [ "$token" = - ] || renew "$token" $((${limit%.*} + within))
}

give_ownership() { # change the owner of $1, which root created, to the owner of this folder, so that it can be deleted
    path=$1
    set -- $(ls -ldn .)
    chown "$3:$4" "$path"
}

fail_late() { # fail because the jobs of this folder were stopped already
    by=
    read -r by 2>/dev/null <.ended
    fail "job $name cannot start: the jobs of $dir were stopped${by:+ by $by}"
}

exec_with_timeout() { # replace the shell by the command in $2..., with a timeout of $1 seconds
    cd / # the timeout of busybox runs a second longer, and must not be a process in a deleted folder
    exec timeout "$@"
}

exit_when_requested() { # exit with $1 when the caller closes standard input to request the result, or after a timeout
    [ ! -c /proc/self/fd/0 ] || exit "$1" # standard input is /dev/null: report without a request
    read_uptime
    [ "$now" -ge "$over_s" ] || (exec_with_timeout $((over_s - now)) cat) >/dev/null 2>&1
    case $? in
        0 | 124 | 143) ;;
        *) while read -r _; do :; done ;; # the timeout of old versions of busybox has another syntax
    esac
    exit "$1"
}

detach() {
    # The job is started in the foreground of a subshell, which the leader of the job kills. A process that is started
    # with & ignores SIGINT, and not every setsid can fork. The shell prints a message about the killed subshell with the
    # next command, so that command is within the redirection, too.
    { (read -r shell _ </proc/self/stat; setsid sh "$self" supervise "$shell" "$@" </dev/null >/dev/null; :); :; } 2>/dev/null
}

wait_until_ready() { # wait until the job in $meta is ready
    [ "$how" != run ] || ready=-
    read_uptime
    until_s=$((now + within)) polls=0
    [ "$ready" = - ] || sleep_for 0.01 # a job with a condition needs at least this time
    until [ -s "$meta/pid" ] && is_ready "$ready" "$log"; do
        if ended "$meta"; then
            [ -s "$meta/exit" ] || [ ! -e .ended ] || fail_late
            is_ready "$ready" "$log" && return
            [ -s "$meta/exit" ] || ! rebooted "$meta" || result "$meta"
            fail "job $name ended before it was ready
$(tail -n 3 "$log" 2>/dev/null)"
        fi
        read_uptime
        if [ "$now" -gt "$until_s" ]; then
            [ -s "$meta/pid" ] || ! rebooted "$meta" || result "$meta"
            [ -s "$meta/pid" ] || fail_to_write "$meta/pid"
            alive "$meta" && signal KILL && await "$meta" 1
            fail "job $name was not ready within $within s
$(tail -n 3 "$log" 2>/dev/null)"
        fi
        sleep_before_poll
    done
    [ -s "$meta/exit" ] || [ ! -e .ended ] || fail_late
}

await() { # wait for the end of the job in $1, for at most $2 seconds
    [ -e "$1/pid" ] || result "$1"
    if [ -p "$1/end" ] && [ -w "$1/end" ]; then
        # First opened for reading and writing, because opening for reading would block without a writer.
        exec 8<>"$1/end" 7<"$1/end" 8>&-
        if [ -z "${2-}" ]; then
            read -r _ <&7
        else
            (exec_with_timeout "$2" cat) <&7 >/dev/null 2>&1
            case $? in 124 | 143) return 1 ;; esac
        fi
    fi
    # After the end of the FIFO the process may exist for a moment. Polling is also needed for jobs of older versions of
    # this script without a FIFO, for jobs of root, and for old versions of busybox with another timeout.
    read_uptime
    until_s=$((now + ${2-86400}))
    while alive "$1"; do
        read_uptime
        [ "$now" -le "$until_s" ] || return 1
        sleep_for 0.05
    done
}

settle() { # wait until file $1 has not grown for 20 ms, for at most 2 s
    n=0 last=-1
    while size=$(wc -c <"$1") && [ "$size" != "$last" ] && [ "$n" -lt 100 ]; do
        last=$size n=$((n + 1))
        sleep_for 0.02
    done
}

mark_stopped() { # record that fieldkit stops the job in $meta; a full disk must not prevent the stop
    { printf '' >"$meta/asked"; } 2>/dev/null || :
}

signal() { # send signal $1 to the process group from `alive`; with sudo for captures, which run as root
    kill "-$1" "-$pid" 2>/dev/null || sudo -n sh -c 'kill "-$1" "-$2"' sh "$1" "$pid" 2>/dev/null || ! alive "$meta"
}

remove() { # delete folder $1; the deletion is tried twice, because a concurrent abort may create a file in the folder
    rm -rf -- "$1" 2>/dev/null || rm -rf -- "$1" 2>/dev/null || sudo -n sh -c 'rm -rf -- "$1"' sh "$1" || fail "cannot remove $1"
}

stop() {
    meta=$1/.jobs/$2 log=$1/${6-} end_text=${7-}
    [ -e "$meta/leaves" ] && return
    [ "${5--}" = - ] || settle "$1/$5"
    if alive "$meta" && [ ! -s "$meta/exit" ]; then
        mark_stopped
        signal "$3" || fail "cannot signal the group $pid"
        [ -n "$end_text" ] && reports_end "$4" && return
        await "$meta" "$4" || { signal KILL; await "$meta" 2; }
    fi
    result "$meta"
}

# True if $log contains $end_text within $1 seconds. The job in $meta has then finished its work, and the file `leaves` lets
# `pack` wait for its end.
reports_end() {
    read_uptime
    until_s=$((now + $1)) polls=0
    until has_line_with "$log" "$end_text"; do
        read_uptime
        [ "$now" -le "$until_s" ] && alive "$meta" || return 1
        sleep_before_poll
    done
    printf '' >"$meta/leaves"
}

await_leaving_jobs() { # wait for the jobs of this folder for which `stop` did not wait; set late_error if one has failed
    late_error=
    for meta in .jobs/*; do
        [ -e "$meta/leaves" ] || continue
        alive "$meta" && { await "$meta" 2 || { signal KILL; await "$meta" 2; }; }
        (result "$meta") 2>/dev/null
        code=$?
        [ "$code" -eq 0 ] || late_error="job ${meta##*/} ended with exit code $code"
        [ -s "$meta/exit" ] || ! rebooted "$meta" || late_error="job ${meta##*/} was interrupted: the robot rebooted"
    done
}

# Stop and list all jobs in the folders $@: SIGINT to all, SIGKILL after 2 s. A job with the file `unhurried`, such as a
# program that lands a drone, is not killed (`jobs.landing_marker_file`).
end() {
    for dir do
        [ -d "$dir/.jobs" ] && { printf '%s\n' "${by-}" >"$dir/.ended"; } 2>/dev/null
        for meta in "$dir"/.jobs/*; do
            alive "$meta" && print_job && mark_stopped && signal INT
        done
    done
    may_wait=1 stuck=
    for dir do
        for meta in "$dir"/.jobs/*; do
            alive "$meta" || continue
            [ -n "$may_wait" ] && await "$meta" 2 && continue
            may_wait=
            [ ! -e "$meta/unhurried" ] || continue
            signal KILL && await "$meta" 2 || stuck="$stuck ${dir#"${base%/*}"/}/${meta##*/}"
        done
    done
    [ -z "$stuck" ] || fail "cannot stop$stuck"
}

print_job() { # print a line about the job in $meta, whose pid `alive` has set
    line=
    read -r line <"$meta/command"
    line="${meta%/.jobs/*}/${meta##*/} $pid $line"
    echo "${line#"${base%/*}"/}"
}

left() { # list the running jobs of all trials, and processes in deleted folders
    for meta in "$base"/*/*/.jobs/*; do
        alive "$meta" && print_job
    done
    list_strays
    return 0
}

list_strays() { # list processes in deleted folders of jobs, and send them signal $1 if it is given
    home=$(cd "$base" 2>/dev/null && pwd -P) || return 0
    # grep reads the list of a computer with many processes much faster than the shell.
    ls -ld /proc/[0-9]*/cwd 2>/dev/null | grep -F "/cwd -> $home/" | while read -r line; do
        case $line in *"/cwd -> $home/"*" (deleted)") ;; *) continue ;; esac
        pid=${line%%/cwd -> *} where=${line#*"/cwd -> $home/"}
        pid=${pid##*/} where=${where% (deleted)}
        echo "${base##*/}/$where $pid $(tr '\0\n' '  ' 2>/dev/null <"/proc/$pid/cmdline")"
        [ -z "${1-}" ] || kill "-$1" "$pid" 2>/dev/null || sudo -n kill "-$1" "$pid" 2>/dev/null
    done
}

command_loop() { # run the commands from standard input in sequence, each a line `NONCE [held] VERB WORD...`, quoted for a shell
    echo ready
    while read -r nonce line; do
        echo "$nonce" >&2
        echo "$nonce"
        (eval "main ${line#held }") </dev/null
        code=$?
        case $line in "held "*) read -r _ || exit ;; esac # wait until the caller requests the result
        echo "$nonce $code" >&2
        echo "$nonce $code"
    done
}

main() {
    verb=${1-}
    [ $# -gt 0 ] && shift
    case $verb in
        sample | sample_clock | health | poll) "$verb" "$@" ;;
        snapshot) snapshot "$base/.sources-$$" - - ;;
        start | run | serve) launch "$verb" "$@" ;;
        wait) await "$1/.jobs/$2" "$3" || exit 124; result "$1/.jobs/$2" ;;
        end) [ ! -d "$1" ] || end "$1" ;;
        halt) end "$1"/* ;;
        drop) remove "$1"; rmdir "${1%/*}" 2>/dev/null || : ;;
        stop | halt_motion | motion_states | life_signs | begin | pack | piece | sum | tidy | left | lock | renew | unlock | holder | abort | needs | command_loop) "$verb" "$@" ;;
        *) fail "unknown verb '$verb'" ;;
    esac
}

main "$@"
