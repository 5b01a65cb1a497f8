# Stop what moves this robot: the agent's programs that drive it, fly it, or watch a drone.

moves() { # whether the job in $1 is such a program, `drive` or `fly`: sets program
    line=
    read -r line 2>/dev/null <"$1/command" || [ -n "$line" ] || return 1
    case $line in
        *"agent-"*".pyz drive {"*) program=drive ;;
        *"agent-"*".pyz fly {"*) program=fly ;;
        *) return 1 ;;
    esac
}

halt_motion() { # in the name of $1, those of folder $2 alone if it is given
    by=$1 halted=
    # First of all the signals: they need no room on a disk, and nobody waits.
    if [ -n "${2-}" ]; then
        brake "$base/${2#*/}"
    else
        brake "$base"/*/*
        stray_movers
        newest
        # A trial that holds the robot starts nothing from here on, and learns why from `renew`.
        [ "$kind" != held ] || broken stopped || full=1
        brake "$base"/*/* # what was started meanwhile
    fi
    tries=0
    while [ "$tries" -lt 60 ] && awaited; do # each takes 20 ms and a fork
        tries=$((tries + 1))
        nap 0.02
    done
    case $tries$(motion_states $halted) in
        0*) ;;
        *" land"* | *" return"*) nap 0.05 ;; # a drone on the ground has landed by then
    esac
    motion_states $halted
    for name in $halted; do
        meta=$base/${name#*/}
        moves "$meta" && motion_state "$meta"
        # It does not go on, whatever keeps it. A drone's program is not killed: another one may bring the drone down.
        [ "$state:$program" != silent:drive ] || { alive "$meta" && signal KILL; }
    done
    [ -z "${full-}" ] || unwritten "$base/lock"
}

brake() { # signal each such program in folders $@, and add it to halted: TRIAL/ATTEMPT/.jobs/NAME below the home
    for dir do
        # Who starts a program looks for this behind its record, and is seen here or sees it.
        [ -d "$dir/.jobs" ] && { printf '%s\n' "$by" >"$dir/.ended"; } 2>/dev/null
        for meta in "$dir"/.jobs/*; do
            name=${meta#"${base%/*}"/}
            case " $halted " in *" $name "*) continue ;; esac
            moves "$meta" && alive "$meta" || continue
            halted="$halted $name"
            ask
            # A suspended one gets the first signal with the second.
            signal INT
            signal CONT
        done
    done
}

stray_movers() { # the same for those whose folder was removed: they have no record, and are listed as ended
    home=$(cd "$base" 2>/dev/null && pwd -P) || return 0
    ls -ld /proc/[0-9]*/cwd 2>/dev/null | while read -r line; do
        case $line in *"/cwd -> $home/"*" (deleted)") ;; *) continue ;; esac
        pid=${line%%/cwd -> *} where=${line#*"/cwd -> $home/"}
        pid=${pid##*/} where=${where% (deleted)}
        case $(tr '\0\n' '  ' 2>/dev/null <"/proc/$pid/cmdline") in
            *"agent-"*".pyz drive {"* | *"agent-"*".pyz fly {"*) ;;
            *) continue ;;
        esac
        kill -INT "$pid" 2>/dev/null
        kill -CONT "$pid" 2>/dev/null
        echo "${base##*/}/$where/.jobs/$pid ended"
    done
}

awaited() { # whether one of halted has not said yet what becomes of its robot
    for name in $halted; do
        moves "$base/${name#*/}" && motion_state "$base/${name#*/}"
        [ "$state" != silent ] || return 0
    done
    return 1
}

motion_state() { # set state of the program in $1, whose kind is in program
    state=silent
    if [ "$program" = drive ]; then
        [ ! -e "$1/stationary" ] || state=stationary
    else
        while read -r line || [ -n "$line" ]; do
            case $line in
                *" landed") state=landed ;;
                *" land: "* | "land: "*) state=land ;;
                *" return: "* | "return: "*) state=return ;;
                *" ALARM: "*) state=alarm ;;
            esac
        done 2>/dev/null <"${1%/.jobs/*}/${1##*/}.log"
    fi
    case $state in silent | land | return) alive "$1" || state=ended ;; esac
}

landing() { # list the programs that still bring a drone down, of any trial: DIR/.jobs/NAME STATE
    for meta in "$base"/*/*/.jobs/*; do
        [ -e "$meta/unhurried" ] && alive "$meta" && moves "$meta" && motion_state "$meta" &&
            echo "lands ${meta#"${base%/*}"/} $state"
    done
    return 0
}

life_signs() { # print file $1, which the pilot and the guard of a drone share, and the time since boot
    cat "$1" /proc/uptime
}

motion_states() { # of programs $@
    for name do
        moves "$base/${name#*/}" && motion_state "$base/${name#*/}" && echo "$name $state"
    done
}
