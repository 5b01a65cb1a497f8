/* A physics federate in C99 without libraries: robots that follow commands immediately, on flat ground.
 *
 *     cc -std=c99 -O2 -o carts carts.c -lm
 *     fieldkit cosim run convoy --physics ./carts
 *
 * The protocol is described in docs/federates.md. Standard input and output carry it; messages for people go to
 * standard error. */

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { JOIN = 1, HELLO, WELCOME, ADVANCE_PHYSICS, STATES, ADVANCE_NETWORK, OUTCOMES, PING, PONG, BUSY, FORK, DONE,
       RELEASE, ERROR, BYE };
enum { HEADER_BYTES = 16, STATE_BYTES = 72, VERSION = 1, PHYSICS = 1, TWIST = 1, VELOCITY = 2, DETERMINISTIC = 1 };
#define MAX_FRAME_BYTES (16u << 20)

/* ---- Bytes in and out, little endian on every machine ---- */

typedef struct { const uint8_t *data; size_t size, at; int is_short; } Reader;
typedef struct { uint8_t *data; size_t size, capacity; } Writer;

static const uint8_t *get_bytes(Reader *reader, size_t count)
{
    static const uint8_t zeros[UINT16_MAX]; /* as long as the longest text */
    if (count > reader->size - reader->at) {
        reader->is_short = 1;
        reader->at = reader->size;
        return zeros;
    }
    reader->at += count;
    return reader->data + reader->at - count;
}

static uint64_t get(Reader *reader, int bytes)
{
    const uint8_t *data = get_bytes(reader, (size_t)bytes);
    uint64_t value = 0;
    for (int i = bytes - 1; i >= 0; i--)
        value = value << 8 | data[i];
    return value;
}

static double get_f64(Reader *reader)
{
    uint64_t bits = get(reader, 8);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void skip_text(Reader *reader) { get_bytes(reader, (size_t)get(reader, 2)); }

static void put_bytes(Writer *writer, const void *data, size_t count)
{
    if (writer->size + count > writer->capacity) {
        writer->capacity = 2 * (writer->size + count);
        writer->data = realloc(writer->data, writer->capacity);
        if (writer->data == NULL)
            exit(2);
    }
    memcpy(writer->data + writer->size, data, count);
    writer->size += count;
}

static void put(Writer *writer, uint64_t value, int bytes)
{
    for (int i = 0; i < bytes; i++) {
        uint8_t byte = (uint8_t)(value >> (8 * i));
        put_bytes(writer, &byte, 1);
    }
}

static void put_f64(Writer *writer, double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    put(writer, bits, 8);
}

static void put_text(Writer *writer, const char *text)
{
    put(writer, strlen(text), 2);
    put_bytes(writer, text, strlen(text));
}

/* ---- The simulator ---- */

typedef struct { int type; double values[4]; } Command;
typedef struct { double position[3], velocity[3], heading; Command now, next; } Agent;

static Agent *agents;
static uint32_t agent_count;
static int64_t step_ns, at_ns, next_from_ns;

static void step_agent(Agent *agent)
{
    double step_s = (double)step_ns / 1e9;
    const double *values = agent->now.values;
    if (agent->now.type == TWIST) {
        agent->heading += values[1] * step_s;
        agent->velocity[0] = values[0] * cos(agent->heading);
        agent->velocity[1] = values[0] * sin(agent->heading);
    } else if (agent->now.type == VELOCITY) {
        memcpy(agent->velocity, values, sizeof agent->velocity);
        if (!isnan(values[3]))
            agent->heading = values[3];
    }
    for (int i = 0; i < 3; i++)
        agent->position[i] += agent->velocity[i] * step_s;
}

static void advance(int64_t to_ns)
{
    for (; at_ns + step_ns <= to_ns; at_ns += step_ns)
        for (uint32_t i = 0; i < agent_count; i++) {
            if (agents[i].next.type != 0 && at_ns >= next_from_ns) {
                agents[i].now = agents[i].next;
                agents[i].next.type = 0;
            }
            step_agent(&agents[i]);
        }
}

/* ---- Messages: each function returns NULL, or why it refuses the request ---- */

static const char *hello(Reader *reader, Writer *answer)
{
    uint8_t hash[32];
    if (memcmp(get_bytes(reader, 8), "FIELDKIT", 8) != 0 || get(reader, 2) != VERSION)
        return "this is not version 1 of the protocol";
    if (get(reader, 1) != PHYSICS)
        return "this federate is a physics federate";
    get_bytes(reader, 1 + 4 + 8); /* reserved, heartbeat_ms, seed */
    step_ns = (int64_t)get(reader, 8);
    get_bytes(reader, 8); /* end_ns */
    memcpy(hash, get_bytes(reader, sizeof hash), sizeof hash);
    skip_text(reader); /* token */
    skip_text(reader); /* name of the scenario */
    agent_count = (uint32_t)get(reader, 4);
    if (reader->is_short || step_ns <= 0 || agent_count > (reader->size - reader->at) / STATE_BYTES)
        return "hello is malformed";
    agents = calloc(agent_count + 1u, sizeof *agents);
    if (agents == NULL)
        return "out of memory";
    for (uint32_t i = 0; i < agent_count; i++) {
        skip_text(reader);            /* name */
        skip_text(reader);            /* profile */
        get_bytes(reader, 1 + 8 + 8); /* flies, antenna_m; the state's agent and reserved */
        for (int k = 0; k < 3; k++)
            agents[i].position[k] = get_f64(reader);
        get_bytes(reader, 3 * 8); /* velocity */
        agents[i].heading = get_f64(reader);
        get_bytes(reader, 8); /* limit */
    }
    if (reader->is_short) /* what follows is the configuration, which this federate does not need */
        return "hello is malformed";
    put(answer, VERSION, 2);
    put(answer, PHYSICS, 1);
    put(answer, 0, 1);
    put(answer, DETERMINISTIC, 4);
    put(answer, (uint64_t)step_ns, 8);
    put(answer, UINT64_MAX, 8); /* next_event_ns: -1 */
    put_bytes(answer, hash, sizeof hash);
    put_text(answer, "carts in C");
    put_text(answer, "carts.c");
    put(answer, 2, 2);
    put(answer, TWIST, 2);
    put(answer, VELOCITY, 2);
    put(answer, 0, 2); /* transports */
    put(answer, 0, 4); /* transmitters */
    put(answer, 0, 4); /* emitters */
    return NULL;
}

static const char *advance_physics(Reader *reader, Writer *answer)
{
    int64_t to_ns = (int64_t)get(reader, 8), from_ns = (int64_t)get(reader, 8);
    uint32_t count = (uint32_t)get(reader, 4);
    if (agents == NULL)
        return "hello is missing";
    if (count > 0 && !reader->is_short) {
        advance(from_ns); /* earlier commands apply until then */
        next_from_ns = from_ns;
    }
    for (uint32_t i = 0; i < count && !reader->is_short; i++) {
        uint32_t index = (uint32_t)get(reader, 4);
        int type = (int)get(reader, 2), size = (int)get(reader, 2);
        if (index >= agent_count)
            return "a command is to an agent that was not announced";
        if (!(type == TWIST && size == 16) && !(type == VELOCITY && size == 32))
            return "a command has an unknown type";
        agents[index].next.type = type;
        for (int k = 0; k < size / 8; k++)
            agents[index].next.values[k] = get_f64(reader);
    }
    if (reader->is_short || reader->at != reader->size)
        return "the request is malformed";
    advance(to_ns);
    put(answer, (uint64_t)at_ns, 8);
    put(answer, 0, 4); /* no new agents */
    put(answer, agent_count, 4);
    for (uint32_t i = 0; i < agent_count; i++) {
        put(answer, i, 4);
        put(answer, 0, 4);
        for (int k = 0; k < 3; k++)
            put_f64(answer, agents[i].position[k]);
        for (int k = 0; k < 3; k++)
            put_f64(answer, agents[i].velocity[k]);
        put_f64(answer, agents[i].heading);
        put_f64(answer, INFINITY); /* the limit of the acceleration is unknown */
    }
    return NULL;
}

int main(void)
{
    Writer answer = {0}, frame = {0};
    uint8_t header[HEADER_BYTES], *body = NULL;
    while (fread(header, 1, sizeof header, stdin) == sizeof header) {
        Reader fields = {header, sizeof header, 0, 0};
        uint32_t size = (uint32_t)get(&fields, 4);
        int kind = (int)get(&fields, 2), reply = 0;
        const char *refusal = NULL;
        if (size > MAX_FRAME_BYTES || (body = realloc(body, size + 1u)) == NULL || fread(body, 1, size, stdin) != size)
            return 2;
        Reader reader = {body, size, 0, 0};
        answer.size = frame.size = 0;
        if (kind == BYE)
            return 0;
        if (kind == RELEASE)
            continue;
        if (kind == HELLO && agents == NULL) {
            refusal = hello(&reader, &answer);
            reply = WELCOME;
        } else if (kind == ADVANCE_PHYSICS) {
            refusal = advance_physics(&reader, &answer);
            reply = STATES;
        } else if (kind == PING) {
            put(&answer, get(&reader, 8), 8);
            reply = PONG;
        } else {
            refusal = "the request is not supported";
        }
        if (refusal != NULL) {
            answer.size = 0;
            put_text(&answer, refusal);
            reply = ERROR;
        }
        put(&frame, answer.size, 4);
        put(&frame, (uint64_t)reply, 2);
        put(&frame, 0, 2);
        put_bytes(&frame, header + 8, 8); /* request and copy */
        put_bytes(&frame, answer.data, answer.size);
        if (fwrite(frame.data, 1, frame.size, stdout) != frame.size || fflush(stdout) != 0 || refusal != NULL)
            return 1;
    }
    return 0; /* the coordinator has closed the connection */
}
