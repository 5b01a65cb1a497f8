# Stop the motion programs of this robot: the programs of the agent (fieldkit's Python program on robots) that drive it, fly
# it, or guard a drone, which means that they land the drone if the program that flies it stops.

is_motion_program() { # true if the job in $1 is a motion program; sets program to `drive` or `fly`
    line=
    read -r line 2>/dev/null <"$1/command" || [ -n "$line" ] || return 1
    case $line in
        *"agent-"*".pyz drive {"*) program=drive ;;
        *"agent-"*".pyz fly {"*) program=fly ;;
        *) return 1 ;;
    esac
}

halt_motion() { # stop the motion programs, and record that user $1 stopped them; if folder $2 is given, only the programs of this folder
    by=$1 programs=
    # The signals are sent first: they need no disk space and no wait.
    if [ -n "${2-}" ]; then
        signal_programs "$base/${2#*/}"
    else
        signal_programs "$base"/*/*
        signal_strays
        read_newest
        # After this the trial that has the lock starts no program, and `renew` reports the reason to it.
        [ "$kind" != held ] || record_break stopped || has_failed=1
        signal_programs "$base"/*/* # programs that were started in the meantime
    fi
    tries=0
    while [ "$tries" -lt 60 ] && is_any_silent; do # each try takes 20 ms and a fork
        tries=$((tries + 1))
        sleep_for 0.02
    done
    case $tries$(motion_states $programs) in
        0*) ;; # there is no program, or each had reported its state before
        *" land"* | *" return"*) sleep_for 0.05 ;; # a drone on the ground reports `landed` within this time
    esac
    motion_states $programs
    for name in $programs; do
        meta=$base/${name#*/}
        is_motion_program "$meta" && motion_state "$meta"
        # A driving program that does not react is killed. A program of a drone is not: it may still land the drone.
        [ "$state:$program" != silent:drive ] || { alive "$meta" && signal KILL; }
    done
    [ -z "${has_failed-}" ] || fail_to_write "$base/lock"
}

signal_programs() { # signal each motion program in folders $@, and add it to programs: DIR/.jobs/NAME, DIR below the home
    for dir do
        # A starting program writes its pid and then checks for this file. Therefore this function detects the program, or
        # the program detects the file.
        [ -d "$dir/.jobs" ] && { printf '%s\n' "$by" >"$dir/.ended"; } 2>/dev/null
        for meta in "$dir"/.jobs/*; do
            name=${meta#"${base%/*}"/}
            case " $programs " in *" $name "*) continue ;; esac
            is_motion_program "$meta" && alive "$meta" || continue
            programs="$programs $name"
            mark_stopped
            # A suspended process handles SIGINT after SIGCONT.
            signal INT
            signal CONT
        done
    done
}

signal_strays() { # signal motion programs whose folder was deleted; they have no record, so they are listed as silent
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
        echo "${base##*/}/$where/.jobs/$pid silent"
    done
}

is_any_silent() { # true if one of programs has not reported the state of its robot yet
    for name in $programs; do
        is_motion_program "$base/${name#*/}" && motion_state "$base/${name#*/}"
        [ "$state" != silent ] || return 0
    done
    return 1
}

motion_state() { # set state to the state of the program in $1; program must be set
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
    case $state in silent | land | return) ;; *) return 0 ;; esac
    ! alive "$1" || return 0
    code=
    read -r code 2>/dev/null <"$1/exit"
    case $state$code in silent7) state=idle ;; *) state=ended ;; esac # 7: CANCELLED in fieldkit/agent/orders.py
}

list_landing() { # list the programs of all trials that still land a drone: DIR/.jobs/NAME STATE
    for meta in "$base"/*/*/.jobs/*; do
        [ -e "$meta/unhurried" ] && alive "$meta" && is_motion_program "$meta" && motion_state "$meta" &&
            echo "lands ${meta#"${base%/*}"/} $state"
    done
    return 0
}

life_signs() { # print file $1, which the pilot and the guard of a drone share, and the time since boot
    cat "$1" /proc/uptime
}

motion_states() { # print the states of the programs in $@
    for name do
        is_motion_program "$base/${name#*/}" && motion_state "$base/${name#*/}" && echo "$name $state"
    done
}
