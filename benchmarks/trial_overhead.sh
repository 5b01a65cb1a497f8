#!/bin/bash
# The steps of a trial as a shell script, over persistent OpenSSH connections (ControlMaster):
#
#   trial_overhead.sh SSH_CONFIG OUT SENDER_ADDRESS RECEIVER_ADDRESS RECORD_S IDLE_S PINGS PING_INTERVAL_S
#
# Reads lines `PROTOCOL NUMBER`, runs that repeat, and prints the name of each phase at its start, and `done`. Evidence of
# a repeat is in OUT/PROTOCOL-NUMBER/{sender,receiver}/, checked against its hashes; a line is appended to OUT/trial.csv.
set -euo pipefail

config=$1 out=$2 sender=$3 receiver=$4 record_s=$5 idle_s=$6 pings=$7 interval_s=$8
port=1234 port_hex=04D2 old=

on() { ssh -F "$config" "$1" "$2" </dev/null; } # robot, command line for its shell

both() { # command line that both robots run in parallel; `$me` is the role
    on sender "me=sender; $1" &
    on receiver "me=receiver; $1"
    wait $!
}

state='state() {
    date -u +%s.%N
    tail -n +1 /proc/net/snmp /proc/net/netstat /proc/net/dev /proc/loadavg
    [ ! -r /proc/net/wireless ] || tail -n +1 /proc/net/wireless
    ip -s link show dev wlan0
    ! command -v ethtool >/dev/null || ethtool -k wlan0
    ! command -v iw >/dev/null || iw dev wlan0 station dump || : # fails on an emulated robot
}'

# No data is on a control connection between the start of the sender and the exit of the listener: the listener's session
# is silent until it exits, and the sender's session exits only after the end of its standard input.
transfer() { # options of both nc, options of the listener
    on receiver "cd $run && exec nc.traditional $1 -l -p $port $2 </dev/null >recv.bag 2>receiver-listen.log" &
    local listener=$!
    on receiver "until grep -qsE ':$port_hex [0-9A-F]+:0000 (0A|07) ' /proc/net/tcp /proc/net/udp; do sleep 0.002; done"
    coproc sending {
        ssh -F "$config" sender "cd $run && nc.traditional $1 -q 0 $receiver $port <scan.bag >sender-send.log 2>&1
            cat >/dev/null"
    }
    local sender_session=$sending_PID
    wait $listener
    exec {sending[1]}>&-
    wait $sender_session
}

collect() { # robot: fetch its files and check them
    mkdir -p "$folder/$1"
    on "$1" "cd $run && rm -f ./*.pid; $state; state >$1-after.txt; sha256sum * >.sums && mv .sums SHA256SUMS && \
        tar -cf - *" | tar -xf - -C "$folder/$1"
    (cd "$folder/$1" && sha256sum --quiet -c SHA256SUMS)
}

check_capture() { # log of tcpdump; fails if a packet was dropped, or not all matching packets were written
    awk '/listening on/ {up = 1} /packets? captured/ {captured = $1} /received by filter/ {received = $1}
        /dropped by/ {dropped += $1} END {exit !(up && captured != "" && captured == received && !dropped)}' "$1"
}

repeat() { # protocol, number
    run=run/$1-$2 folder=$out/$1-$2

    both "rm -rf '$old'; mkdir -p $run && cd $run && $state; state >\$me-before.txt"

    echo record
    on sender "cd $run && . /opt/ros/noetic/setup.bash && \
        rosbag record --duration=$record_s -O scan /scan >sender-record.log 2>&1"

    echo start captures
    both "cd $run && { setsid tcpdump -i wlan0 -n -U --immediate-mode -s 128 -B 4096 -w \$me.pcap \
        'host $sender and host $receiver and (port $port or icmp or ip[6:2] & 0x1fff != 0)' \
        </dev/null >\$me-capture.log 2>&1 & echo \$! >capture.pid; }
        until grep -qs 'listening on' \$me-capture.log; do kill -0 \$(<capture.pid) || exit; sleep 0.002; done"

    echo transfer
    if [ "$1" = udp ]; then transfer -u "-w $idle_s"; else transfer '' ''; fi

    echo drain captures
    both "cd $run; last=-1; until size=\$(stat -c %s \$me.pcap) && [ \$size = \$last ]; do last=\$size; sleep 0.02; done
        pid=\$(<capture.pid); kill \$pid && while kill -0 \$pid 2>/dev/null; do sleep 0.002; done"

    echo ping
    local payload=502
    [ "$1" = tcp ] || payload=8192
    on sender "cd $run && LC_ALL=C ping -n -D -c $pings -i $interval_s -s $payload -W 2 $receiver \
        >ping.txt 2>sender-ping.log" || [ $? = 1 ] # 1: replies are missing, which is a valid result

    echo collect evidence
    collect sender &
    collect receiver
    wait $!
    check_capture "$folder/sender/sender-capture.log"
    check_capture "$folder/receiver/receiver-capture.log"
    [ -s "$folder/sender/scan.bag" ]
    [ -e "$folder/receiver/recv.bag" ]
    [ -s "$folder/sender/ping.txt" ]
    sent=$(stat -c %s "$folder/sender/scan.bag") received=$(stat -c %s "$folder/receiver/recv.bag")
    rtt=$(awk -F'[ /]' '/^rtt/ {print $8}' "$folder/sender/ping.txt")
    echo "$1,$2,$sent,$received,$rtt" >>"$out/trial.csv"
    sync "$folder"/*/* "$folder"/* "$folder" "$out" "$out/trial.csv"
    old=$run
}

while read -r protocol number; do
    repeat "$protocol" "$number"
    echo done
done
