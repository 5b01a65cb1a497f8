# Who holds this robot.
#
# The lock is the highest-numbered lock.N beside this file that is whole: KIND TOKEN BOOT FROM TO SINCE UNTIL WHO WHAT,
# where KIND is held, free or aborted, FROM and TO are seconds since boot, SINCE and UNTIL those of the clock.
#
# Two laptops may come at once, and there may be no flock: each change of the lock is a new file with the next number,
# which only one can create. The highest number is never removed; so whoever created a number that had been used and
# removed before finds a higher one. A record is on the disk before it gets its number, and the one before it is there
# until then: neither a full disk nor the end of power leaves a robot with a lock that says nothing.
TTL=3600

newest() { # set n to the highest number, 0 if there is none, read the newest record that is whole, set torn to how many are not
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
            newest # a newer one took its place meanwhile
            return
        fi
    done
}

record() { # KIND TOKEN SECONDS WHO WHAT: write the next record; false if somebody else was sooner, or it cannot be written
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

wall() { # set wall to what the clock says, whatever else `date` does, and to 0 where it tells no time
    wall=$(date +%s)
    wall=${wall##*[!0-9]}
    wall=${wall:-0}
}

age() { # set age and rest of the record: seconds since it was made, and until it expires; false once it has expired
    clock
    read -r boot </proc/sys/kernel/random/boot_id
    if [ "$booted" = "$boot" ]; then
        age=$((now - from)) rest=$((to - now)) # a clock that is set meanwhile changes nothing
    else
        wall
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
        # An older version of this script writes its record after it has created it.
        [ "$torn" -gt 0 ] && [ "$try" -lt 4 ] && nap 0.05 && continue
        record held "$@" && return
    done
    unwritten "$base/lock"
}

renew() { # the lock of $1: at half its time, or where less than $2 seconds are left, then for half an hour more than those
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
        free:-) lock "$1" "$TTL" somebody "$1" ;; # the robot lost its files
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

broken() { # break the lock in the name of $by, as $1 says: aborted or stopped; false if that cannot be written; kind, who and what are those of before
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
