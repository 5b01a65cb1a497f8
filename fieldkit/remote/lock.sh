# The lock of this robot.
#
# The lock is the complete file lock.N with the highest number in the folder of this script. It contains KIND TOKEN BOOT
# FROM TO SINCE UNTIL WHO WHAT. KIND is held, free, aborted or stopped. FROM and TO are the start and the expiry of the lock
# in seconds since boot; SINCE and UNTIL are the same times in seconds of the clock.
#
# Two laptops may change the lock at the same time, and flock may be missing. Therefore each change creates a new file with
# the next number, which only one process can create. The highest number is never deleted, so a process that creates a
# number which was used and deleted before detects a higher one. A record is flushed to the disk before it gets its number,
# and the previous record exists until then: neither a full disk nor a power failure leaves a robot without a valid record.
TTL=3600 # lifetime of a lock that is not renewed, in seconds; as TTL_S in locks.py

read_newest() { # read the newest complete record; set n to the highest number (0: none), incomplete to the number of incomplete records
    n=0 best=0 incomplete=0 kind=free holder=- record_boot=- from=0 to=0 since=0 until=0 who=- what=-
    for record in "$base"/lock.*; do
        number=${record##*.}
        case $number in *[!0-9]*) continue ;; esac
        [ "$number" -le "$n" ] || n=$number
        [ "$number" -gt "$best" ] || continue
        if read -r kind_ holder_ record_boot_ from_ to_ since_ until_ who_ what_ 2>/dev/null <"$record" && [ -n "$what_" ]; then
            case $from_$to_$since_$until_ in
                *[!0-9]*) incomplete=$((incomplete + 1)) ;;
                *)
                    best=$number kind=$kind_ holder=$holder_ record_boot=$record_boot_ from=$from_ to=$to_
                    since=$since_ until=$until_ who=$who_ what=$what_
                    ;;
            esac
        elif [ -e "$record" ]; then
            incomplete=$((incomplete + 1))
        else
            read_newest # it was replaced by a newer record in the meantime
            return
        fi
    done
}

# Write the next record with the arguments KIND TOKEN SECONDS WHO WHAT; false if another process was faster, or on an error.
write_record() {
    read_uptime
    read -r boot </proc/sys/kernel/random/boot_id
    read_wall_clock
    line="$1 $2 $boot $now $((now + $3)) $wall $((wall + $3)) $4 $5"
    next=$((n + 1)) new_record=$base/new-lock.$$
    { printf '%s\n' "$line" >"$new_record"; } 2>/dev/null && sync_to_disk "$new_record" && ln "$new_record" "$base/lock.$next" 2>/dev/null
    code=$?
    rm -f "$new_record"
    [ "$code" -eq 0 ] || return 1
    read_newest
    if [ "$n" -ne "$next" ]; then
        rm -f "$base/lock.$next"
        return 1
    fi
    sync_to_disk "$base"
    for record in "$base"/lock.*; do
        number=${record##*.}
        case $number in *[!0-9]*) continue ;; esac
        [ "$number" -ge "$next" ] || rm -f "$record"
    done
}

read_wall_clock() { # set wall to the clock in seconds, or to 0 if `date` fails
    wall=$(date +%s)
    wall=${wall##*[!0-9]}
    wall=${wall:-0}
}

read_age() { # set age to the seconds since the record was written, and remaining to those until it expires; false if it has expired
    read_uptime
    read -r boot </proc/sys/kernel/random/boot_id
    if [ "$record_boot" = "$boot" ]; then
        age=$((now - from)) remaining=$((to - now)) # independent of changes of the clock
    else
        read_wall_clock
        age=$((wall - since)) remaining=$((until - wall))
    fi
    # After a boot, a clock without a battery may show a time in the past.
    [ "$remaining" -gt 0 ] && [ "$age" -ge 0 ]
}

lock() {
    for try in 1 2 3 4 5 6 7 8; do
        read_newest
        if [ "$kind" = held ] && [ "$holder" != "$1" ] && read_age; then
            fail "held $age $remaining $since $who $what" "$HELD"
        fi
        # An older version of this script creates the file before it writes the record.
        [ "$incomplete" -gt 0 ] && [ "$try" -lt 4 ] && sleep_for 0.05 && continue
        write_record held "$@" && return
    done
    fail_to_write "$base/lock"
}

renew() { # extend the lock of token $1 to at least $2 s + 30 min, if half of its time has passed or less than $2 s remain
    read_newest
    case $kind:$holder in
        held:"$1")
            read_age && [ "$remaining" -gt "$age" ] && [ "$remaining" -gt "$2" ] && return
            span=$((until - since))
            [ "$span" -gt $(($2 + TTL / 2)) ] || span=$(($2 + TTL / 2))
            lock "$1" "$span" "$who" "$what"
            ;;
        held:*) fail "held $since $who $what" "$LOST" ;;
        aborted:"$1" | stopped:"$1") fail "$kind $since $who $what" "$LOST" ;;
        free:-) lock "$1" "$TTL" unknown-user "$1" ;; # no record exists: the files of the robot were lost
        *) fail "gone $since $who $what" "$LOST" ;;
    esac
}

unlock() {
    for try in 1 2 3 4 5 6 7 8; do
        read_newest
        [ "$kind:$holder" = "held:$1" ] || return 0
        write_record free "$1" 0 "$who" "$what" && return
    done
    fail_to_write "$base/lock"
}

holder() {
    read_newest
    [ "$kind" = held ] && read_age && echo "$holder $remaining $who $what"
    return 0
}

# Break the lock, record that user $1 broke it, and stop all jobs. If the disk is full, try to break the lock again after the jobs, which
# may have filled it, were stopped.
abort() {
    by=$1
    record_break aborted && has_failed= || has_failed=1
    [ "$kind" = held ] && echo "held $who $what" || echo free
    list_strays KILL
    end "$base"/*/*
    list_landing
    [ -z "$has_failed" ] || record_break aborted || [ "$kind" != held ] || fail_to_write "$base/lock"
}

# Write a record of kind $1 (aborted or stopped) by $by. Set kind, who and what to those of the previous record; false on an
# error.
record_break() {
    how=$1
    for try in 1 2 3 4 5 6 7 8; do
        read_newest
        set -- "$kind" "$who" "$what"
        if write_record "$how" "$holder" 0 "$by" "$what"; then
            kind=$1 who=$2 what=$3
            return
        fi
    done
    return 1
}
