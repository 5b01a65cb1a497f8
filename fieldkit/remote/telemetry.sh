# What a robot's Wi-Fi says of its link while an attempt lasts, as iw and the kernel print it.
#
# A tick forks nothing where the shell can wait by itself, and iw is called on it only as long as all of this has used
# less than its share of a core: on a small computer a process costs milliseconds. Nothing of it meets the air.

TICK=0.2
SEEN=500 # so many hundredths of a second pass between looks at the channel, the cell and the lock
SHARE=12 AHEAD=3000 # thousandths of a core, and as many thousandths of a hundredth of a second ahead of that
BLOCKS=8192 # of 512 or 1,024 bytes: no file of it gets longer

watch() { # $1 role, $2 interface: begin to sample in this folder; nothing without iw, or where it was begun before
    PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
    command -v iw >/dev/null && mkdir "$PWD/.jobs/link" 2>/dev/null || return 0
    meta=$PWD/.jobs/link shell=sh
    ! command -v bash >/dev/null || shell=bash # which can wait by itself
    read -r token _ <.began
    echo "sample the link of $2" >"$meta/command"
    detach "$meta" 86400 - 0 /dev/null "$1-link.txt" "$meta/log" "$shell" "$self" sample "$2" "$token"
}

unwatch() { # $1 role: end it
    meta=.jobs/link
    [ -d "$meta" ] || return 0
    clock
    until_s=$((now + 2))
    # What was begun a moment ago has yet to say who it is.
    while [ ! -s "$meta/pid" ] && clock && [ "$now" -le "$until_s" ]; do nap 0.002; done
    if alive "$meta"; then
        ask
        signal TERM
        while alive "$meta" && clock && [ "$now" -le "$until_s" ]; do nap 0.002; done
        ! alive "$meta" || signal KILL
    fi
    [ ! -e "$1-link.txt" ] || gzip -nf "$1-link.txt" 2>/dev/null || :
}

sample() { # $1 interface, $2 token of the lock, or -: until it is ended, the folder goes, or the lock is another's
    interface=$1 token=$2 look=0 again=0 wifi=
    ulimit -f "$BLOCKS"
    exec 8<>.jobs/link/end # into which nobody writes
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
                # It fails where there is no Wi-Fi, and also while a station is being lost.
                said=$(iw dev "$interface" link) || [ -n "$wifi" ] || return 0
                wifi=1
                echo "$said"
                section survey
                iw dev "$interface" survey dump
                # Of its own cell a station may know more than it has in a list: brcmfmac, Realtek's drivers.
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

moment_of() { # set up to the seconds since boot, and $1 to the hundredths
    read -r up _ </proc/uptime
    eval "$1=\${up%.*}\${up#*.}"
}

spending() { # set used to what this shell and its children have used, in hundredths of a second
    read -r stat <"/proc/$$/stat"
    set -- ${stat##*) }
    used=$((${12} + ${13} + ${14} + ${15})) # fields 14 to 17
}

section() {
    echo "==> $up $1 <=="
}

quality() { # what a driver tells without iw, of a station; set told to whether it does
    told=
    [ -r /proc/net/wireless ] || return 0
    while read -r name line; do
        [ "$name" != "$interface:" ] || { told=1; section wireless; echo "$line"; }
    done </proc/net/wireless
}

ours() { # whether the lock is still $token's
    newest
    [ "$kind:$holder" = "held:$token" ] && age
}
