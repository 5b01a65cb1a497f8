# The lock of this robot.
#
# The lock is the complete file lock.N with the highest number in the folder of this script. It contains KIND TOKEN BOOT
# FROM TO SINCE UNTIL WHO WHAT: KIND is held, free, aborted or stopped, FROM and TO are seconds since boot, SINCE and UNTIL
# seconds of the clock.
#
# Two laptops may change the lock at the same time, and flock may be missing: each change creates a new file with the next
# number, which only one of them can create. The highest number is never deleted, so a process that creates a number which
# was used and deleted before detects a higher one. A record is flushed to the disk before it gets its number, and the
# previous record exists until then: neither a full disk nor a power failure leaves a robot without a valid record.
TTL=3600

newest() { # set n to the highest number (0: none) and torn to the number of incomplete records, read the newest complete one
    n=0 best=0 torn=0 kind=free holder=- booted=- from=0 to=0 since=0 until=0 who=- what=-
    for record in "$base"/lock.*; do
        number=${record##*.}
        case $number in *[!0-9]*) continue ;; esac
        [ "$number" -le "$n" ] || n=$number
        [ "$number" -gt "$best" ] || continue
        if read -r kind_ holder_ booted_ from_ to_ since_ until_ who_ what_ 2>/dev/null <"$record" && [ -n "$what_" ]; then
            case $from_$to_$since_$until_ in
                *[!0-9]*) torn=$((torn + 1)) ;;
                *)
                    best=$number kind=$kind_ holder=$holder_ booted=$booted_ from=$from_ to=$to_
                    since=$since_ until=$until_ who=$who_ what=$what_
                    ;;
            esac
        elif [ -e "$record" ]; then
            torn=$((torn + 1))
        else
            newest # it was replaced by a newer record in the meantime
            return
        fi
    done
}

record() { # KIND TOKEN SECONDS WHO WHAT: write the next record; false if another process was faster, or on an error
    clock
    read -r boot </proc/sys/kernel/random/boot_id
    wall
    line="$1 $2 $boot $now $((now + $3)) $wall $((wall + $3)) $4 $5"
    next=$((n + 1)) fresh=$base/new-lock.$$
    { printf '%s\n' "$line" >"$fresh"; } 2>/dev/null && lasting "$fresh" && ln "$fresh" "$base/lock.$next" 2>/dev/null
    code=$?
    rm -f "$fresh"
    [ "$code" -eq 0 ] || return 1
    newest
    if [ "$n" -ne "$next" ]; then
        rm -f "$base/lock.$next"
        return 1
    fi
    lasting "$base"
    for record in "$base"/lock.*; do
        number=${record##*.}
        case $number in *[!0-9]*) continue ;; esac
        [ "$number" -ge "$next" ] || rm -f "$record"
    done
}

wall() { # set wall to the clock in seconds, or to 0 if `date` fails
    wall=$(date +%s)
    wall=${wall##*[!0-9]}
    wall=${wall:-0}
}

age() { # set age and rest to the seconds since the record was made and until it expires; false if it has expired
    clock
    read -r boot </proc/sys/kernel/random/boot_id
    if [ "$booted" = "$boot" ]; then
        age=$((now - from)) rest=$((to - now)) # independent of changes of the clock
    else
        wall
        age=$((wall - since)) rest=$((until - wall))
    fi
    # The clock of a robot without a battery for it may be in the past after a boot.
    [ "$rest" -gt 0 ] && [ "$age" -ge 0 ]
}

lock() {
    for try in 1 2 3 4 5 6 7 8; do
        newest
        if [ "$kind" = held ] && [ "$holder" != "$1" ] && age; then
            fail "held $age $rest $since $who $what" "$HELD"
        fi
        # An older version of this script creates the file before it writes the record.
        [ "$torn" -gt 0 ] && [ "$try" -lt 4 ] && nap 0.05 && continue
        record held "$@" && return
    done
    unwritten "$base/lock"
}

renew() { # the lock of token $1 after half of its time, or if less than $2 seconds remain: for at least $2 s + 30 min
    newest
    case $kind:$holder in
        held:"$1")
            age && [ "$rest" -gt "$age" ] && [ "$rest" -gt "$2" ] && return
            span=$((until - since))
            [ "$span" -gt $(($2 + TTL / 2)) ] || span=$(($2 + TTL / 2))
            lock "$1" "$span" "$who" "$what"
            ;;
        held:*) fail "held $since $who $what" "$LOST" ;;
        aborted:"$1" | stopped:"$1") fail "$kind $since $who $what" "$LOST" ;;
        free:-) lock "$1" "$TTL" somebody "$1" ;; # the robot has lost its files
        *) fail "gone $since $who $what" "$LOST" ;;
    esac
}

unlock() {
    for try in 1 2 3 4 5 6 7 8; do
        newest
        [ "$kind:$holder" = "held:$1" ] || return 0
        record free "$1" 0 "$who" "$what" && return
    done
    unwritten "$base/lock"
}

holder() {
    newest
    [ "$kind" = held ] && age && echo "$holder $rest $who $what"
    return 0
}

abort() {
    by=$1
    broken aborted && full= || full=1
    [ "$kind" = held ] && echo "held $who $what" || echo free
    strays KILL
    end "$base"/*/*
    landing
    [ -z "$full" ] || broken aborted || [ "$kind" != held ] || unwritten "$base/lock"
}

broken() { # write a record of kind $1 (aborted or stopped) by $by; kind, who and what are then those of the previous record; false on an error
    how=$1
    for try in 1 2 3 4 5 6 7 8; do
        newest
        set -- "$kind" "$who" "$what"
        if record "$how" "$holder" 0 "$by" "$what"; then
            kind=$1 who=$2 what=$3
            return
        fi
    done
    return 1
}
