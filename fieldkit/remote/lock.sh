# Who holds this robot.
#
# The lock is the highest-numbered lock.N beside this file: KIND TOKEN BOOT FROM TO SINCE UNTIL WHO WHAT, where KIND is
# held, free or aborted, FROM and TO are seconds since boot, SINCE and UNTIL those of the clock.
#
# Two laptops may come at once, and there may be no flock: each change of the lock is a new file with the next number,
# which only one can create. The highest number is never removed; so whoever created a number that had been used and
# removed before finds a higher one.
newest() { # set n to the number of the newest record, 0 if there is none, and read it
    n=0 kind=free holder=- booted=- from=0 to=0 since=0 until=0 who=- what=-
    for record in "$base"/lock.*; do
        number=${record##*.}
        case $number in *[!0-9]*) ;; *) [ "$number" -le "$n" ] || n=$number ;; esac
    done
    [ "$n" -eq 0 ] && return
    read -r kind holder booted from to since until who what 2>/dev/null <"$base/lock.$n"
    case " $from $to $since $until " in *[!0-9\ ]* | *"  "*) kind=torn ;; esac
    [ -e "$base/lock.$n" ] || newest # a newer one took its place meanwhile
}

record() { # KIND TOKEN SECONDS WHO WHAT: write the next record; false if somebody else was sooner
    clock
    read -r boot </proc/sys/kernel/random/boot_id
    wall=$(date +%s)
    line="$1 $2 $boot $now $((now + $3)) $wall $((wall + $3)) $4 $5"
    next=$((n + 1)) previous=$n
    set -C
    { printf '%s\n' "$line" >"$base/lock.$next"; } 2>/dev/null
    code=$?
    set +C
    [ "$code" -eq 0 ] || return 1
    newest
    if [ "$n" -ne "$next" ]; then
        rm -f "$base/lock.$next"
        return 1
    fi
    rm -f "$base/lock.$previous"
}

age() { # set age and rest of the record: seconds since it was made, and until it expires; false once it has expired
    clock
    read -r boot </proc/sys/kernel/random/boot_id
    if [ "$booted" = "$boot" ]; then
        age=$((now - from)) rest=$((to - now)) # a clock that is set meanwhile changes nothing
    else
        wall=$(date +%s)
        age=$((wall - since)) rest=$((until - wall))
    fi
    # A robot without a battery for its clock may have booted into the past.
    [ "$rest" -gt 0 ] && [ "$age" -ge 0 ]
}

lock() {
    for try in 1 2 3 4 5 6 7 8; do
        newest
        if [ "$kind" = held ] && [ "$holder" != "$1" ] && age; then
            fail "held $age $rest $since $who $what" "$HELD"
        fi
        # Who creates a record writes it at once; one that stays torn was cut by a full disk or the end of power.
        [ "$kind" = torn ] && [ "$try" -lt 4 ] && nap 0.05 && continue
        record held "$@" && return
    done
    unwritten "$base/lock"
}

renew() { # the lock of $1, at half its time
    newest
    case $kind:$holder in
        held:"$1")
            age && [ "$rest" -gt "$age" ] || lock "$1" $((until - since)) "$who" "$what"
            ;;
        held:*) fail "held $since $who $what" "$LOST" ;;
        aborted:"$1") fail "aborted $since $who $what" "$LOST" ;;
        free:-) ;; # nobody holds it: the robot lost its files
        *) fail "gone $since $who $what" "$LOST" ;;
    esac
}

unlock() {
    newest
    while [ "$kind:$holder" = "held:$1" ]; do
        record free "$1" 0 "$who" "$what" && return
        newest
    done
}

holder() {
    newest
    [ "$kind" = held ] && age && echo "$holder $rest $who $what"
    return 0
}

abort() {
    for try in 1 2 3 4 5 6 7 8; do
        newest
        record aborted "$holder" 0 "$1" "$what" && break
    done
    end "$base"/*/*
}
