# Sample the state of a robot's Wi-Fi link during an attempt, from the output of iw and the kernel; and run the commands of
# the telemetry sources in its profile (`poll`).
#
# An iteration needs no fork if the shell has a `read` with a timeout. iw is called only while this job has used less than
# its share of a core, because a process takes milliseconds on a small computer. Nothing is sent over the radio.

TICK=0.2 # s between samples
CHECK_INTERVAL=500 # interval of checks of the channel, the access point and the lock, in units of 10 ms
SHARE=12 AHEAD=3000 # CPU budget in thousandths of a core, and initial credit in units of 10 us
BLOCKS=8192 # limit of the file size, in blocks of 512 or 1,024 bytes

# Set radio to the Wi-Fi interface that carries the frames of interface $1: $1, or one below it (bat0 of batman-adv, a
# bridge).
find_radio() {
    PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
    radio=$1
    # The lines are `4: wlan0: ...` or `5: wlan0.2@wlan0: ...`.
    for lower in $(ip -o link show master "$1" 2>/dev/null | awk '{ sub(/[:@].*/, "", $2); print $2 }'); do
        ! timeout -s KILL "$SOURCE_S" iw dev "$lower" info >/dev/null 2>&1 || radio=$lower
    done
}

# Start a job that samples the radio with interface $2 of role $1. Do nothing without iw, or if it was started before.
start_sampler() {
    PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
    command -v iw >/dev/null && mkdir "$PWD/.jobs/link" 2>/dev/null || return 0
    meta=$PWD/.jobs/link shell=sh
    ! command -v bash >/dev/null || shell=bash # its `read` has a timeout
    read -r token _ <.began
    echo "sample the link of $2" >"$meta/command"
    detach "$meta" 86400 - 0 /dev/null "$1-link.txt" "$meta/log" "$shell" "$self" sample "$2" "$token"
}

# Stop the jobs of the link, of the clock and of the telemetry sources of role $1; compress the files of the link and of the
# sources.
stop_samplers() {
    for meta in .jobs/link .jobs/clock .jobs/telemetry-*; do
        [ -d "$meta" ] || continue
        end_sampler
    done
    for sampled in "$1-link.txt" "$1-telemetry-"*.txt; do
        [ ! -e "$sampled" ] || gzip -nf "$sampled" 2>/dev/null || :
    done
}

end_sampler() { # stop the sampler in $meta
    read_uptime
    until_s=$((now + 2)) polls=0
    # A job that was just started may not have written its pid yet.
    while [ ! -s "$meta/pid" ] && read_uptime && [ "$now" -le "$until_s" ]; do sleep_before_poll; done
    if alive "$meta"; then
        mark_stopped
        signal TERM
        while alive "$meta" && read_uptime && [ "$now" -le "$until_s" ]; do sleep_before_poll; done
        ! alive "$meta" || signal KILL
    fi
}

# Start a job for each telemetry source. $1 role, $2 interface; then for each source a quoted line with its NAME and the
# arguments of `poll` from ADDRESS on.
poll_sources() {
    PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
    role=$1 interface=$2
    shift 2
    read -r token _ <.began
    for line do poll_source "$line"; done
}

poll_source() { # start the job of the source in the quoted line $1, unless it was started before
    eval "set -- $1"
    meta=$PWD/.jobs/telemetry-$1 file=$role-telemetry-$1.txt
    mkdir "$meta" 2>/dev/null || return 0
    shift
    echo "query a telemetry source: $*" >"$meta/command"
    detach "$meta" 86400 - 0 /dev/null "$file" "$meta/log" sh "$self" poll .began "$token" "$@"
}

MAX_OUTPUT=65536 # limit of an output, in bytes
MAX_TOTAL=4194304 # limit of all outputs of a source

# Run ARGV at intervals and print its outputs, until file $1 no longer exists, the lock of token $2 (-: none) is lost, the
# outputs exceed MAX_TOTAL, or packets to ADDRESS would leave by INTERFACE. The other arguments: ADDRESS that is queried, or
# -; INTERFACE by which packets to ADDRESS must not leave, or -; INTERVAL in s (0: run once); LIMIT of a run in s; ARGV...
poll() {
    required_file=$1 token=$2 address=$3 tested_interface=$4 interval=$5 limit=$6 total=0 child=
    shift 6
    output=$PWD/.poll-$$
    export LC_ALL=C # mmcli prints numbers with a comma in some languages
    trap end_poll TERM INT HUP
    exec 2>/dev/null # shells print a message for each killed command
    while [ -e "$required_file" ]; do
        [ "$token" = - ] || owns_lock || break
        read -r up _ </proc/uptime
        if uses_tested_interface; then
            printf '==> %s interface 0 <==\n\n' "$up"
            break
        fi
        (ulimit -f $((MAX_OUTPUT / 512 + 1)) && exec timeout -s KILL "$limit" "$@") >"$output" 2>"$output-errors" </dev/null &
        child=$!
        wait "$child"
        code=$? child=
        # The error message of a query with an ADDRESS may contain its credentials, so it is not printed.
        if [ "$code" -ne 0 ] && [ "$address" = - ]; then
            dd if="$output-errors" of="$output" bs=300 count=1
        fi
        size=$(($(wc -c <"$output")))
        [ "$size" -le "$MAX_OUTPUT" ] || { size=0 code=large && : >"$output"; }
        printf '==> %s %s %s <==\n' "$up" "$code" "$size"
        cat "$output"
        echo
        total=$((total + size))
        [ "$interval" -gt 0 ] && [ "$total" -le "$MAX_TOTAL" ] || break
        sleep "$interval" &
        child=$!
        wait "$child"
        child=
    done
    rm -f -- "$output" "$output-errors"
}

end_poll() { # stop the running command, which timeout has made the leader of a process group
    trap '' TERM INT HUP
    [ -z "$child" ] || kill -KILL "-$child" || kill -KILL "$child"
    rm -f -- "$output" "$output-errors"
    exit 0
}

uses_tested_interface() { # true if packets to $address leave by the interface under test
    [ "$address" != - ] && [ "$tested_interface" != - ] && route=$(ip route get "$address") || return 1
    case "$route " in *" dev $tested_interface "*) ;; *) return 1 ;; esac
}

# Print samples of interface $1 until this job is stopped, its folder is deleted, or the lock of token $2 (-: none) is lost;
# return earlier if the interface is not Wi-Fi.
sample() {
    interface=$1 token=$2 next_check=0 next_query=0 wifi=
    ulimit -f "$BLOCKS"
    exec 8<>.jobs/link/end # no process writes to this FIFO: `read` from it is a sleep without a fork
    # A shell whose `read` has no timeout prints an error message.
    [ -z "$({ read -r -t 0.01 _ <&8; } 2>&1)" ] && has_read_timeout=1 || has_read_timeout=
    read_time first
    read_cpu_time
    used_before=$used
    while [ -e .began ]; do
        read_time at
        print_quality
        if [ "$at" -ge "$next_query" ]; then
            if [ "$at" -ge "$next_check" ]; then
                next_check=$((at + CHECK_INTERVAL))
                [ "$token" = - ] || owns_lock || return 0
                print_heading link
                # The command fails if the interface is not Wi-Fi, and also while the connection to a station is being lost.
                link_text=$(iw dev "$interface" link) || [ -n "$wifi" ] || return 0
                wifi=1
                echo "$link_text"
                print_heading survey
                iw dev "$interface" survey dump
                # With some drivers (brcmfmac, Realtek) `station get` of the access point reports more than `station dump`.
                cell=${link_text#Connected to }
                [ "$cell" = "$link_text" ] && set -- station dump || set -- station get "${cell%% *}"
            fi
            print_heading station
            iw dev "$interface" "$@" || next_check=0
            read_cpu_time
            next_query=$((first + ((used - used_before) * 1000 - AHEAD) / SHARE))
        fi
        # The pause is short only if the kernel reports a link quality, or if iw must be called again.
        [ -n "$has_quality" ] || [ "$at" -ge "$next_query" ] && pause=$TICK || pause=1
        if [ -n "$has_read_timeout" ]; then read -r -t "$pause" _ <&8; else sleep_for 1; fi
    done
    return 0
}

read_time() { # set up to the seconds since boot, and variable $1 to hundredths of a second
    read -r up _ </proc/uptime
    eval "$1=\${up%.*}\${up#*.}"
}

read_cpu_time() { # set used to the CPU time of this shell and its children, in hundredths of a second
    read -r stat <"/proc/$$/stat"
    set -- ${stat##*) }
    used=$((${12} + ${13} + ${14} + ${15})) # fields 14 to 17
}

print_heading() { # print the heading of section $1
    echo "==> $up $1 <=="
}

print_quality() { # print the link quality from /proc/net/wireless; set has_quality if the kernel reports one, as for a station
    has_quality=
    [ -r /proc/net/wireless ] || return 0
    while read -r name line; do
        [ "$name" != "$interface:" ] || { has_quality=1; print_heading wireless; echo "$line"; }
    done </proc/net/wireless
}

owns_lock() { # true if the lock is still that of $token
    read_newest
    [ "$kind:$holder" = "held:$token" ] && read_age
}
