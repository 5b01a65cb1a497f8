# Sample the state of a robot's Wi-Fi link during an attempt, from the output of iw and the kernel.
#
# An iteration needs no fork if the shell has a `read` with a timeout. iw is called only while this job has used less than
# its share of a core, because a process takes milliseconds on a small computer. Nothing is sent over the radio.

TICK=0.2
SEEN=500 # interval of checks of the channel, the cell and the lock, in 10 ms
SHARE=12 AHEAD=3000 # CPU budget in thousandths of a core, and advance on it in 10 us
BLOCKS=8192 # limit of the file size, in blocks of 512 or 1,024 bytes

watch() { # $1 role, $2 interface: start to sample in this folder; does nothing without iw, or if it was started before
    PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
    command -v iw >/dev/null && mkdir "$PWD/.jobs/link" 2>/dev/null || return 0
    meta=$PWD/.jobs/link shell=sh
    ! command -v bash >/dev/null || shell=bash # its `read` has a timeout
    read -r token _ <.began
    echo "sample the link of $2" >"$meta/command"
    detach "$meta" 86400 - 0 /dev/null "$1-link.txt" "$meta/log" "$shell" "$self" sample "$2" "$token"
}

unwatch() { # $1 role: stop it, and the sources of the profile
    for meta in .jobs/link .jobs/telemetry-*; do
        [ -d "$meta" ] || continue
        end_sampler
    done
    for sampled in "$1-link.txt" "$1-telemetry-"*.txt; do
        [ ! -e "$sampled" ] || gzip -nf "$sampled" 2>/dev/null || :
    done
}

end_sampler() { # stop the sampler in $meta
    clock
    until_s=$((now + 2)) polls=0
    # A job that was just started may not have written its pid yet.
    while [ ! -s "$meta/pid" ] && clock && [ "$now" -le "$until_s" ]; do nap_before_poll; done
    if alive "$meta"; then
        ask
        signal TERM
        while alive "$meta" && clock && [ "$now" -le "$until_s" ]; do nap_before_poll; done
        ! alive "$meta" || signal KILL
    fi
}

poll_sources() { # $1 role, $2 interface, then a quoted line for each source: NAME and the words of `poll` from ADDRESS on
    PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
    role=$1 interface=$2
    shift 2
    read -r token _ <.began
    for line do poll_source "$line"; done
}

poll_source() { # $1 quoted line of a source; does nothing if it was started before
    eval "set -- $1"
    meta=$PWD/.jobs/telemetry-$1 file=$role-telemetry-$1.txt
    mkdir "$meta" 2>/dev/null || return 0
    shift
    echo "query a telemetry source: $*" >"$meta/command"
    detach "$meta" 86400 - 0 /dev/null "$file" "$meta/log" sh "$self" poll .began "$token" "$@"
}

QUERIED=65536 # limit of an output, in bytes
POLLED=4194304 # limit of all outputs of a source

poll() { # $1 file without which it ends, $2 token of the lock or -, ADDRESS or -, INTERFACE that ADDRESS must not use, or -,
    # INTERVAL in s (0: once), LIMIT of a run in s, ARGV...
    present=$1 token=$2 address=$3 tested=$4 interval=$5 limit=$6 total=0 child=
    shift 6
    output=$PWD/.poll-$$
    export LC_ALL=C # mmcli prints numbers with a comma in some languages
    trap end_poll TERM INT HUP
    exec 2>/dev/null # shells print a message for each killed command
    while [ -e "$present" ]; do
        [ "$token" = - ] || ours || break
        read -r up _ </proc/uptime
        if over_tested; then
            printf '==> %s interface 0 <==\n\n' "$up"
            break
        fi
        (ulimit -f $((QUERIED / 512 + 1)) && exec timeout -s KILL "$limit" "$@") >"$output" 2>"$output-errors" </dev/null &
        child=$!
        wait "$child"
        code=$? child=
        # Errors of queries with credentials may contain these.
        if [ "$code" -ne 0 ] && [ "$address" = - ]; then
            dd if="$output-errors" of="$output" bs=300 count=1
        fi
        size=$(($(wc -c <"$output")))
        [ "$size" -le "$QUERIED" ] || { size=0 code=large && : >"$output"; }
        printf '==> %s %s %s <==\n' "$up" "$code" "$size"
        cat "$output"
        echo
        total=$((total + size))
        [ "$interval" -gt 0 ] && [ "$total" -le "$POLLED" ] || break
        sleep "$interval" &
        child=$!
        wait "$child"
        child=
    done
    rm -f -- "$output" "$output-errors"
}

end_poll() { # end the running command, which timeout has made the leader of a process group
    trap '' TERM INT HUP
    [ -z "$child" ] || kill -KILL "-$child" || kill -KILL "$child"
    rm -f -- "$output" "$output-errors"
    exit 0
}

over_tested() { # true if packets to $address leave by the interface under test
    [ "$address" != - ] && [ "$tested" != - ] && route=$(ip route get "$address") || return 1
    case "$route " in *" dev $tested "*) ;; *) return 1 ;; esac
}

sample() { # $1 interface, $2 token of the lock, or -: until it is stopped, the folder is deleted, or the lock is lost
    interface=$1 token=$2 look=0 again=0 wifi=
    ulimit -f "$BLOCKS"
    exec 8<>.jobs/link/end # no process writes to it: only used to wait
    [ -z "$({ read -r -t 0.01 _ <&8; } 2>&1)" ] && waits=1 || waits=
    moment_of first
    spending
    spent=$used
    while [ -e .began ]; do
        moment_of at
        quality
        if [ "$at" -ge "$again" ]; then
            if [ "$at" -ge "$look" ]; then
                look=$((at + SEEN))
                [ "$token" = - ] || ours || return 0
                section link
                # It fails if the interface is not Wi-Fi, and also while a station is being lost.
                said=$(iw dev "$interface" link) || [ -n "$wifi" ] || return 0
                wifi=1
                echo "$said"
                section survey
                iw dev "$interface" survey dump
                # With some drivers (brcmfmac, Realtek) `station get` of the own cell reports more than `station dump`.
                cell=${said#Connected to }
                [ "$cell" = "$said" ] && set -- station dump || set -- station get "${cell%% *}"
            fi
            section station
            iw dev "$interface" "$@" || look=0
            spending
            again=$((first + ((used - spent) * 1000 - AHEAD) / SHARE))
        fi
        [ -n "$told" ] || [ "$at" -ge "$again" ] && pause=$TICK || pause=1
        if [ -n "$waits" ]; then read -r -t "$pause" _ <&8; else nap 1; fi
    done
    return 0
}

moment_of() { # set up to the seconds since boot, and variable $1 to hundredths of a second
    read -r up _ </proc/uptime
    eval "$1=\${up%.*}\${up#*.}"
}

spending() { # set used to the CPU time of this shell and its children, in hundredths of a second
    read -r stat <"/proc/$$/stat"
    set -- ${stat##*) }
    used=$((${12} + ${13} + ${14} + ${15})) # fields 14 to 17
}

section() {
    echo "==> $up $1 <=="
}

quality() { # print the link quality from /proc/net/wireless, which is available for stations; set told if there is any
    told=
    [ -r /proc/net/wireless ] || return 0
    while read -r name line; do
        [ "$name" != "$interface:" ] || { told=1; section wireless; echo "$line"; }
    done </proc/net/wireless
}

ours() { # true if $token still holds the lock
    newest
    [ "$kind:$holder" = "held:$token" ] && age
}
