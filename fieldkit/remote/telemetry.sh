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

unwatch() { # $1 role: stop it
    meta=.jobs/link
    [ -d "$meta" ] || return 0
    clock
    until_s=$((now + 2))
    # A job that was just started may not have written its pid yet.
    while [ ! -s "$meta/pid" ] && clock && [ "$now" -le "$until_s" ]; do nap 0.002; done
    if alive "$meta"; then
        ask
        signal TERM
        while alive "$meta" && clock && [ "$now" -le "$until_s" ]; do nap 0.002; done
        ! alive "$meta" || signal KILL
    fi
    [ ! -e "$1-link.txt" ] || gzip -nf "$1-link.txt" 2>/dev/null || :
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
