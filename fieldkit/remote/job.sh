# Jobs that go on without a connection, and the verbs.

launch() { # $1 is start, run or serve
    how=$1 dir=$2 name=$3 limit=$4 ready=$5 within=$6 in=$7 out=$8 log=$9
    shift 9
    enter "$dir"
    meta=$PWD/.jobs/$name
    clock
    over_s=$((now + ${limit%.*} + within + 10)) # by then the caller has asked, or never will
    if [ -d "$meta" ]; then
        ours=
    elif [ -e .ended ]; then
        late
    elif keep && why=$(mkdir "$meta" 2>&1); then
        ours=1
        [ -O . ] || give "$meta"
        printf '%s\n' "$*" >"$meta/command"
        set -- "$meta" "$limit" "$ready" "$within" "$in" "$out" "$log" "$@"
    else
        ours=
        [ -d "$meta" ] || fail "cannot start job $name: $why"
    fi
    case $how$ours in
        run1)
            setsid sh "$self" supervise - "$@" </dev/null
            code=$?
            [ -s "$meta/pid" ] || unwritten "$meta/pid"
            [ -s "$meta/exit" ] || [ ! -e .ended ] || late
            conclude "$code"
            ;;
        run)
            rise
            await "$meta"
            result "$meta"
            conclude $?
            ;;
        *1) detach "$@" ;;
    esac
    [ "$how" = serve ] || { rise; return; }
    # Who joins a job that was up does not mind that it has ended since.
    [ -e "$meta/up" ] || rise
    { printf '' >"$meta/up"; } 2>/dev/null
    echo up
    await "$meta" $((${limit%.*} + 10)) || exit 124
    result "$meta"
}

keep() { # the lock that the folder was made under, until a job with this limit has ended
    token=-
    [ ! -s .began ] || read -r token _ <.began
    [ "$token" = - ] || renew "$token" $((${limit%.*} + within))
}

give() { # what root made to the owner of this folder, who removes it one day
    made=$1
    set -- $(ls -ldn .)
    chown "$3:$4" "$made"
}

late() {
    by=
    read -r by 2>/dev/null <.ended
    fail "job $name comes too late: the jobs of $dir were ended${by:+ by $by}"
}

within_s() { # become the command after $1, which has so many seconds
    cd / # a folder that is removed meanwhile has nothing left in it: busybox watches for a second longer
    exec timeout "$@"
}

conclude() { # end with $1 once the caller closes standard input, which says that it wants to be told, or is never heard of
    [ ! -c /proc/self/fd/0 ] || exit "$1" # it was /dev/null from the beginning
    clock
    [ "$now" -ge "$over_s" ] || (within_s $((over_s - now)) cat) >/dev/null 2>&1
    case $? in
        0 | 124 | 143) ;;
        *) while read -r _; do :; done ;; # an old busybox has another timeout
    esac
    exit "$1"
}

detach() {
    # In the foreground of a shell of its own, which the job's leader ends: what is started with & ignores SIGINT
    # for ever, and not every setsid can fork. What the shell says of the end of the other is said with the next command.
    { (read -r shell _ </proc/self/stat; setsid sh "$self" supervise "$shell" "$@" </dev/null >/dev/null; :); :; } 2>/dev/null
}

rise() { # wait until the job in $meta is up
    [ "$how" != run ] || ready=-
    # What has to begin something takes that long at least, and each look takes from it a part of the processor.
    [ "$ready" = - ] && pause=0.002 || pause=0.01
    clock
    until_s=$((now + within))
    until [ -s "$meta/pid" ] && ready "$ready" "$log"; do
        if ended "$meta"; then
            [ -s "$meta/exit" ] || [ ! -e .ended ] || late
            ready "$ready" "$log" && return
            [ -s "$meta/exit" ] || ! rebooted "$meta" || result "$meta"
            fail "job $name ended before it was ready
$(tail -n 3 "$log" 2>/dev/null)"
        fi
        clock
        if [ "$now" -gt "$until_s" ]; then
            [ -s "$meta/pid" ] || ! rebooted "$meta" || result "$meta"
            [ -s "$meta/pid" ] || unwritten "$meta/pid"
            alive "$meta" && signal KILL && await "$meta" 1
            fail "job $name was not up in $within s
$(tail -n 3 "$log" 2>/dev/null)"
        fi
        nap "$pause"
        pause=0.002
    done
    [ -s "$meta/exit" ] || [ ! -e .ended ] || late
}

await() { # the end of the job in $1, for $2 seconds at most
    [ -e "$1/pid" ] || result "$1"
    if [ -p "$1/end" ] && [ -w "$1/end" ]; then
        # Opened for both first, so that opening does not wait for a writer where there is none any more.
        exec 8<>"$1/end" 7<"$1/end" 8>&-
        if [ -z "${2-}" ]; then
            read -r _ <&7
        else
            (within_s "$2" cat) <&7 >/dev/null 2>&1
            case $? in 124 | 143) return 1 ;; esac
        fi
    fi
    # Who has met the end has yet to see the process go. And a job of an older version of this script has no end to
    # meet, one of root's is not ours to meet, an old busybox has another timeout.
    clock
    until_s=$((now + ${2-86400}))
    while alive "$1"; do
        clock
        [ "$now" -le "$until_s" ] || return 1
        nap 0.05
    done
}

settle() { # wait until file $1 has not grown for 20 ms, 2 s at most
    n=0 last=-1
    while size=$(wc -c <"$1") && [ "$size" != "$last" ] && [ "$n" -lt 100 ]; do
        last=$size n=$((n + 1))
        nap 0.02
    done
}

ask() { # note that the end of the job in $meta is ours; a full disk must not keep us from ending it
    { printf '' >"$meta/asked"; } 2>/dev/null || :
}

signal() { # send $1 to the group that alive found; a capture may be root's
    kill "-$1" "-$pid" 2>/dev/null || sudo -n sh -c 'kill "-$1" "-$2"' sh "$1" "$pid" 2>/dev/null || ! alive "$meta"
}

remove() { # what is in $1, also where somebody who aborts makes a file in it meanwhile
    rm -rf -- "$1" 2>/dev/null || rm -rf -- "$1" 2>/dev/null || sudo -n sh -c 'rm -rf -- "$1"' sh "$1" || fail "cannot remove $1"
}

stop() {
    meta=$1/.jobs/$2 log=$1/${6-} parting=${7-}
    [ -e "$meta/leaves" ] && return
    [ "${5--}" = - ] || settle "$1/$5"
    if alive "$meta" && [ ! -s "$meta/exit" ]; then
        ask
        signal "$3" || fail "cannot signal the group $pid"
        [ -n "$parting" ] && parts "$4" && return
        await "$meta" "$4" || { signal KILL; await "$meta" 2; }
    fi
    result "$meta"
}

parts() { # whether the job in $meta says $parting in its $log within $1 seconds, and so has nothing left to do but end
    clock
    until_s=$((now + $1))
    until holds "$log" "$parting"; do
        clock
        [ "$now" -le "$until_s" ] && alive "$meta" || return 1
        nap 0.002
    done
    printf '' >"$meta/leaves"
}

gone() { # the end of every job of this folder that was let go by `stop`; set late to what is wrong with one
    late=
    for meta in .jobs/*; do
        [ -e "$meta/leaves" ] || continue
        alive "$meta" && { await "$meta" 2 || { signal KILL; await "$meta" 2; }; }
        (result "$meta") 2>/dev/null
        code=$?
        [ "$code" -eq 0 ] || late="job ${meta##*/} ended with exit code $code"
        [ -s "$meta/exit" ] || ! rebooted "$meta" || late="job ${meta##*/} was cut: the robot rebooted"
    done
}

end() { # all jobs in the folders $@ and say which: signal all, then give them 2 s together; see `jobs.unhurried_file`
    for dir do
        [ -d "$dir/.jobs" ] && { printf '%s\n' "${by-}" >"$dir/.ended"; } 2>/dev/null
        for meta in "$dir"/.jobs/*; do
            alive "$meta" && describe && ask && signal INT
        done
    done
    patient=1 stuck=
    for dir do
        for meta in "$dir"/.jobs/*; do
            alive "$meta" || continue
            [ -n "$patient" ] && await "$meta" 2 && continue
            patient=
            [ ! -e "$meta/unhurried" ] || continue
            signal KILL && await "$meta" 2 || stuck="$stuck ${dir#"${base%/*}"/}/${meta##*/}"
        done
    done
    [ -z "$stuck" ] || fail "cannot end$stuck"
}

describe() { # the job in $meta that alive found
    line=
    read -r line <"$meta/command"
    line="${meta%/.jobs/*}/${meta##*/} $pid $line"
    echo "${line#"${base%/*}"/}"
}

left() {
    for meta in "$base"/*/*/.jobs/*; do
        alive "$meta" && describe
    done
    strays
    return 0
}

strays() { # list processes in folders of jobs that were removed, and send them $1, if it is given
    home=$(cd "$base" 2>/dev/null && pwd -P) || return 0
    ls -ld /proc/[0-9]*/cwd 2>/dev/null | while read -r line; do
        case $line in *"/cwd -> $home/"*" (deleted)") ;; *) continue ;; esac
        pid=${line%%/cwd -> *} where=${line#*"/cwd -> $home/"}
        pid=${pid##*/} where=${where% (deleted)}
        echo "${base##*/}/$where $pid $(tr '\0\n' '  ' 2>/dev/null <"/proc/$pid/cmdline")"
        [ -z "${1-}" ] || kill "-$1" "$pid" 2>/dev/null || sudo -n kill "-$1" "$pid" 2>/dev/null
    done
}

stand() { # run what standard input asks for, one after the other: a line `NONCE [held] VERB WORD...`, quoted for a shell
    echo ready
    while read -r nonce line; do
        echo "$nonce" >&2
        echo "$nonce"
        (eval "main ${line#held }") </dev/null
        code=$?
        case $line in "held "*) read -r _ || exit ;; esac # until the caller wants to be told
        echo "$nonce $code" >&2
        echo "$nonce $code"
    done
}

main() {
    verb=${1-}
    [ $# -gt 0 ] && shift
    case $verb in
        sample) sample "$@" ;;
        start | run | serve) launch "$verb" "$@" ;;
        wait) await "$1/.jobs/$2" "$3" || exit 124; result "$1/.jobs/$2" ;;
        end) [ ! -d "$1" ] || end "$1" ;;
        halt) end "$1"/* ;;
        drop) remove "$1"; rmdir "${1%/*}" 2>/dev/null || : ;;
        stop | halt_motion | motion_states | life_signs | begin | pack | piece | sum | tidy | left | lock | renew | unlock | holder | abort | needs | stand) "$verb" "$@" ;;
        *) fail "unknown verb '$verb'" ;;
    esac
}

main "$@"
