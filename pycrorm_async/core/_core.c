/* Append a record to a mapped segment, read records back, and make the values of rows: what runs for every event.
 *
 * The Python code beside each call is the reference, and runs where this file is not compiled. Only cases that need no
 * decision are done here: an event of an open episode that fits into the current segment, and whole frames that follow
 * one another. For any other case a function returns without having done it ("not mine"), and Python decides. The
 * layout of frames and segments is specified in `pycrorm_async/queue/__init__.py`.
 *
 * The interpreter lock is the lock. A function first makes all objects that it needs, because the garbage collector may
 * run there, and finalizers with it. Then it reads the state, checks it, and writes, without a call that can fail or
 * run Python code in between. Signal handlers run between two instructions of Python, so none interrupts a function.
 */
#define Py_LIMITED_API 0x030B0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdatomic.h>
#include <stdint.h>
#include <string.h>
#include <structmember.h>

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "segments are little endian, and this file writes numbers as the processor has them"
#endif

/* === crc32 ======================================================================================================
 *
 * The crc32 of zlib. The registers here are inverted, as in the definition of the code: `crc32` inverts them.
 */

static uint32_t tables[8][256]; /* tables[n][byte]: the register after this byte and n zeros */

static void make_tables(void) {
    for (uint32_t byte = 0; byte < 256; byte++) {
        uint32_t crc = byte;
        for (int bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ (crc & 1 ? 0xEDB88320u : 0);
        tables[0][byte] = crc;
    }
    for (int n = 1; n < 8; n++)
        for (int byte = 0; byte < 256; byte++)
            tables[n][byte] = (tables[n - 1][byte] >> 8) ^ tables[0][tables[n - 1][byte] & 255];
}

static uint32_t crc_by_tables(const uint8_t *at, size_t size, uint32_t crc) {
    for (; size >= 8; at += 8, size -= 8) {
        uint64_t word;
        memcpy(&word, at, 8);
        word ^= crc;
        crc = 0;
        for (int n = 0; n < 8; n++) crc ^= tables[7 - n][(word >> 8 * n) & 255];
    }
    for (; size; at++, size--) crc = (crc >> 8) ^ tables[0][(crc ^ *at) & 255];
    return crc;
}

#if defined(__x86_64__)
#include <immintrin.h>
/* Folding with carry-less multiplication, from V. Gopal et al., "Fast CRC Computation for Generic Polynomials Using
 * PCLMULQDQ Instruction", Intel 2009. The constants are x^n modulo the polynomial of crc32, with reflected bits, for
 * the distances of 64 and 16 bytes. Folding keeps the remainder, so the tables finish the last 16 bytes. */
#define FOLDS __attribute__((target("pclmul")))
static int can_fold;

FOLDS static inline __m128i folded(__m128i register_, __m128i distance, const uint8_t *next) {
    __m128i low = _mm_clmulepi64_si128(register_, distance, 0x00);
    __m128i high = _mm_clmulepi64_si128(register_, distance, 0x11);
    return _mm_xor_si128(_mm_xor_si128(low, high), _mm_loadu_si128((const __m128i *)next));
}

FOLDS static uint32_t crc_by_folding(const uint8_t *at, size_t size, uint32_t crc) { /* of 64 bytes or more */
    const __m128i by_64 = _mm_set_epi64x(0x1c6e41596, 0x154442bd4), by_16 = _mm_set_epi64x(0x0ccaa009e, 0x1751997d0);
    __m128i lanes[4];
    for (int n = 0; n < 4; n++) lanes[n] = _mm_loadu_si128((const __m128i *)(at + 16 * n));
    lanes[0] = _mm_xor_si128(lanes[0], _mm_cvtsi32_si128((int)crc));
    for (at += 64, size -= 64; size >= 64; at += 64, size -= 64)
        for (int n = 0; n < 4; n++) lanes[n] = folded(lanes[n], by_64, at + 16 * n);
    uint8_t last[64];
    for (int n = 0; n < 4; n++) _mm_storeu_si128((__m128i *)(last + 16 * n), lanes[n]);
    for (int n = 1; n < 4; n++) lanes[0] = folded(lanes[0], by_16, last + 16 * n);
    for (; size >= 16; at += 16, size -= 16) lanes[0] = folded(lanes[0], by_16, at);
    _mm_storeu_si128((__m128i *)last, lanes[0]);
    return crc_by_tables(at, size, crc_by_tables(last, 16, 0));
}
#endif

static uint32_t crc32(const uint8_t *at, size_t size, uint32_t crc) {
#if defined(__x86_64__)
    if (can_fold && size >= 64) return ~crc_by_folding(at, size, ~crc);
#endif
    return ~crc_by_tables(at, size, ~crc);
}

/* === frames ==================================================================================================== */

enum { EVENT = 1, COMMIT = 3, EPISODE_BYTES = 16, TYPE_BYTES_MAX = 255 };

typedef struct { /* the header of a frame, as it lies in the file; no field needs padding */
    uint8_t kind, type_bytes;
    uint16_t version;
    uint32_t payload_bytes;
    uint64_t position, sequence;
    int64_t wall_ns, monotonic_ns;
    uint8_t episode[EPISODE_BYTES];
    uint32_t salt, checksum;
} Header;

_Static_assert(sizeof(Header) == 64, "a frame's header has 64 bytes");
#define CHECKED offsetof(Header, checksum)

static size_t padded(size_t size) { return (size + 7) & ~(size_t)7; }

/* === append ==================================================================================================== */

typedef struct {
    PyObject_HEAD
    Py_buffer mapping; /* of `buffer`; `mapping.buf` is NULL without one */
    PyObject *buffer, *open, *refusal, *wake, *wall_ns, *monotonic_ns;
    Py_ssize_t offset, end, ordinary_end;
    unsigned long long position, span_count, owner, events_max;
    unsigned int salt, span_checksum;
    char quiet, has_atomic_clock;
} Tail;

static PyObject *not_mine(void) {
    PyErr_Clear(); /* Python meets the same error, and raises it where it belongs */
    Py_RETURN_NONE;
}

/* append(heading, payload, reserved) -> the sequence, or None: not mine */
static PyObject *Tail_append(PyObject *object, PyObject *const *arguments, Py_ssize_t count) {
    Tail *self = (Tail *)object;
    if (count != 3) return PyErr_Format(PyExc_TypeError, "append takes 3 arguments, not %zd", count);
    PyObject *heading = arguments[0], *payload = arguments[1];
    if (!self->has_atomic_clock || !PyTuple_Check(heading) || PyTuple_Size(heading) != 3) return not_mine();
    PyObject *episode = PyTuple_GetItem(heading, 0), *type = PyTuple_GetItem(heading, 1);
    PyObject *number = PyTuple_GetItem(heading, 2);
    if (!PyBytes_CheckExact(episode) || !PyUnicode_CheckExact(type) || !PyLong_CheckExact(number)) return not_mine();
    if (!PyBytes_CheckExact(payload) || PyBytes_Size(episode) != EPISODE_BYTES) return not_mine();
    Py_ssize_t type_bytes, payload_bytes = PyBytes_Size(payload);
    const char *name = PyUnicode_AsUTF8AndSize(type, &type_bytes);
    long version = PyLong_AsLong(number);
    if (!name || type_bytes < 1 || type_bytes > TYPE_BYTES_MAX || version < 0 || version > UINT16_MAX) return not_mine();
    if (payload_bytes > INT32_MAX || strcmp(name, "EpisodeEnded") == 0) return not_mine();
    int reserved = PyObject_IsTrue(arguments[2]);
    PyObject *last = PyTuple_New(3), *answer = NULL, *wall_ns = NULL, *monotonic_ns = NULL;
    if (!last || reserved < 0) goto declined;

    /* From here on nothing runs the collector: numbers are not tracked by it, and the clocks are written in C. */
    if (self->owner || (self->refusal && self->refusal != Py_None) || !self->mapping.buf || !self->open) goto declined;
    if (!self->wall_ns || !self->monotonic_ns || !self->wake) goto declined;
    PyObject *before = PyDict_GetItemWithError(self->open, episode);
    if (!before || !PyTuple_CheckExact(before) || PyTuple_Size(before) != 3) goto declined;
    unsigned long long sequence = PyLong_AsUnsignedLongLong(PyTuple_GetItem(before, 0)) + 1;
    if (sequence == 0 || sequence > self->events_max) goto declined;
    size_t body_bytes = padded((size_t)type_bytes + (size_t)payload_bytes);
    Py_ssize_t size = (Py_ssize_t)(sizeof(Header) + body_bytes), limit = reserved ? self->end : self->ordinary_end;
    if (limit > self->mapping.len || self->offset < 0 || size > limit - self->offset) goto declined;
    answer = PyLong_FromUnsignedLongLong(sequence);
    wall_ns = PyObject_CallNoArgs(self->wall_ns);
    monotonic_ns = PyObject_CallNoArgs(self->monotonic_ns);
    if (!answer || !wall_ns || !monotonic_ns) goto declined;
    Header header = {
        .kind = EVENT, .type_bytes = (uint8_t)type_bytes, .version = (uint16_t)version,
        .payload_bytes = (uint32_t)payload_bytes, .position = self->position + 1, .sequence = sequence,
        .wall_ns = PyLong_AsLongLong(wall_ns), .monotonic_ns = PyLong_AsLongLong(monotonic_ns), .salt = self->salt,
    };
    memcpy(header.episode, PyBytes_AsString(episode), EPISODE_BYTES);
    if (PyErr_Occurred()) goto declined;
    PyTuple_SetItem(last, 0, Py_NewRef(answer));
    PyTuple_SetItem(last, 1, wall_ns);
    PyTuple_SetItem(last, 2, monotonic_ns);
    wall_ns = monotonic_ns = NULL;
    if (PyDict_SetItem(self->open, episode, last) < 0) goto declined; /* it replaces a value, so it takes no memory */
    Py_DECREF(last);

    uint8_t *frame = (uint8_t *)self->mapping.buf + self->offset, *body = frame + sizeof header;
    memcpy(body, name, (size_t)type_bytes);
    memcpy(body + type_bytes, PyBytes_AsString(payload), (size_t)payload_bytes);
    memset(body + type_bytes + payload_bytes, 0, body_bytes - (size_t)(type_bytes + payload_bytes));
    header.checksum = crc32((uint8_t *)&header, CHECKED, crc32(body, body_bytes, 0));
    atomic_signal_fence(memory_order_release); /* the header last: a body without a header does not decode */
    memcpy(frame, &header, sizeof header);
    self->offset += size;
    self->position++;
    self->span_count++;
    self->span_checksum = crc32((uint8_t *)&header.checksum, sizeof header.checksum, self->span_checksum);
    if (self->quiet) {
        self->quiet = 0; /* before the call, which may let the sync thread take this span and set it again */
        PyObject *woken = PyObject_CallNoArgs(self->wake);
        if (!woken) {
            self->quiet = 1;
            Py_DECREF(answer);
            return NULL;
        }
        Py_DECREF(woken);
    }
    return answer;

declined:
    Py_XDECREF(last);
    Py_XDECREF(answer);
    Py_XDECREF(wall_ns);
    Py_XDECREF(monotonic_ns);
    return not_mine();
}

static void release_mapping(Tail *self) {
    if (self->mapping.buf) PyBuffer_Release(&self->mapping);
    self->mapping.buf = NULL;
    Py_CLEAR(self->buffer);
}

static int set_buffer(PyObject *object, PyObject *buffer, void *Py_UNUSED(closure)) {
    Tail *self = (Tail *)object;
    Py_buffer mapping = {0};
    if (buffer && buffer != Py_None && PyObject_GetBuffer(buffer, &mapping, PyBUF_WRITABLE) < 0) return -1;
    release_mapping(self);
    self->mapping = mapping;
    if (mapping.buf) self->buffer = Py_NewRef(buffer);
    return 0;
}

static PyObject *get_buffer(PyObject *object, void *Py_UNUSED(closure)) {
    PyObject *buffer = ((Tail *)object)->buffer;
    return Py_NewRef(buffer ? buffer : Py_None);
}

static int Tail_traverse(PyObject *object, visitproc visit, void *arg) {
    Tail *self = (Tail *)object;
    Py_VISIT(Py_TYPE(object));
    Py_VISIT(self->buffer);
    Py_VISIT(self->open);
    Py_VISIT(self->refusal);
    Py_VISIT(self->wake);
    Py_VISIT(self->wall_ns);
    Py_VISIT(self->monotonic_ns);
    return 0;
}

static int Tail_clear(PyObject *object) {
    Tail *self = (Tail *)object;
    release_mapping(self);
    Py_CLEAR(self->open);
    Py_CLEAR(self->refusal);
    Py_CLEAR(self->wake);
    Py_CLEAR(self->wall_ns);
    Py_CLEAR(self->monotonic_ns);
    return 0;
}

static void Tail_dealloc(PyObject *object) {
    PyTypeObject *type = Py_TYPE(object);
    PyObject_GC_UnTrack(object);
    Tail_clear(object);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(object);
    Py_DECREF(type);
}

#define MEMBER(name, type, field) {name, type, offsetof(Tail, field), 0, NULL}
static PyMemberDef Tail_members[] = {
    MEMBER("open", T_OBJECT, open), MEMBER("position", T_ULONGLONG, position), MEMBER("owner", T_ULONGLONG, owner),
    MEMBER("_offset", T_PYSSIZET, offset), MEMBER("_end", T_PYSSIZET, end),
    MEMBER("_ordinary_end", T_PYSSIZET, ordinary_end), MEMBER("_span_count", T_ULONGLONG, span_count),
    MEMBER("_span_checksum", T_UINT, span_checksum), MEMBER("_salt", T_UINT, salt), MEMBER("_quiet", T_BOOL, quiet),
    MEMBER("_refusal", T_OBJECT, refusal), MEMBER("_wake", T_OBJECT, wake),
    MEMBER("_wall_ns", T_OBJECT, wall_ns),
    MEMBER("_monotonic_ns", T_OBJECT, monotonic_ns), MEMBER("_has_atomic_clock", T_BOOL, has_atomic_clock),
    MEMBER("_events_max", T_ULONGLONG, events_max), {0}};
static PyGetSetDef Tail_properties[] = {{"_buffer", get_buffer, set_buffer, NULL, NULL}, {0}};
#define FAST(function) ((PyCFunction)(void (*)(void))(function))
static PyMethodDef Tail_methods[] = {{"append", FAST(Tail_append), METH_FASTCALL, NULL}, {0}};
static PyType_Slot Tail_slots[] = {
    {Py_tp_members, Tail_members}, {Py_tp_getset, Tail_properties}, {Py_tp_methods, Tail_methods},
    {Py_tp_traverse, Tail_traverse}, {Py_tp_clear, Tail_clear}, {Py_tp_dealloc, Tail_dealloc}, {0, NULL}};
static PyType_Spec Tail_spec = {"pycrorm_async.core._core.Tail", sizeof(Tail), 0,
                                Py_TPFLAGS_DEFAULT | Py_TPFLAGS_BASETYPE | Py_TPFLAGS_HAVE_GC, Tail_slots};

/* === read ====================================================================================================== */

enum { NAMES = 4 };

typedef struct { /* what one call of take_records knows */
    PyObject *types;                /* names of event types by their bytes */
    PyObject *opened;               /* the open episodes with their last records; NULL: sequences are not checked */
    PyObject *episode, *texts[NAMES]; /* of the frame before, and of the latest types */
    const uint8_t *names[NAMES];
    Py_ssize_t name_bytes[NAMES];
    int next_name, is_changed;      /* whether `last` is not in `opened` yet */
    Header last;                    /* of the last record of `episode` */
} Reading;

static PyObject *type_of(Reading *reading, const uint8_t *name, Py_ssize_t size) { /* borrowed; NULL: not mine */
    for (int n = 0; n < NAMES; n++)
        if (reading->texts[n] && reading->name_bytes[n] == size && !memcmp(reading->names[n], name, (size_t)size))
            return reading->texts[n];
    PyObject *key = PyBytes_FromStringAndSize((const char *)name, size);
    PyObject *text = key ? PyDict_GetItemWithError(reading->types, key) : NULL;
    Py_XDECREF(key);
    if (!text) return NULL;
    int n = reading->next_name++ % NAMES;
    reading->texts[n] = text; /* `types` holds it: only Python changes that, and it does not run meanwhile */
    reading->names[n] = name;
    reading->name_bytes[n] = size;
    return text;
}

static int note_last(Reading *reading) { /* put `last` into `opened` */
    if (!reading->is_changed) return 0;
    reading->is_changed = 0;
    Header *last = &reading->last;
    PyObject *value = Py_BuildValue("(KLL)", last->sequence, last->wall_ns, last->monotonic_ns);
    int failed = !value || PyDict_SetItem(reading->opened, reading->episode, value) < 0;
    Py_XDECREF(value);
    return failed ? -1 : 0;
}

static int begin_episode(Reading *reading, const Header *header) { /* 1: ready, 0: not mine, -1: an error */
    if (reading->episode && !memcmp(reading->last.episode, header->episode, EPISODE_BYTES)) return 1;
    if (reading->opened && note_last(reading) < 0) return -1;
    Py_XDECREF(reading->episode);
    reading->episode = PyBytes_FromStringAndSize((const char *)header->episode, EPISODE_BYTES);
    if (!reading->episode) return -1;
    reading->last = *header;
    if (!reading->opened) return 1;
    PyObject *before = PyDict_GetItemWithError(reading->opened, reading->episode);
    if (before && PyTuple_Check(before) && PyTuple_Size(before) == 3) {
        reading->last.sequence = PyLong_AsUnsignedLongLong(PyTuple_GetItem(before, 0));
        if (!PyErr_Occurred()) return 1;
    }
    Py_CLEAR(reading->episode);
    return PyErr_Occurred() ? -1 : 0;
}

static PyObject *record_of(PyTypeObject *kind, const Header *header, PyObject *episode, PyObject *type,
                           const uint8_t *payload) {
    PyObject *record = ((allocfunc)PyType_GetSlot(kind, Py_tp_alloc))(kind, 8);
    if (!record) return NULL;
    PyObject *values[] = {
        PyLong_FromUnsignedLongLong(header->position),
        Py_NewRef(episode),
        PyLong_FromUnsignedLongLong(header->sequence),
        Py_NewRef(type),
        PyLong_FromLong(header->version),
        PyLong_FromLongLong(header->wall_ns),
        PyLong_FromLongLong(header->monotonic_ns),
        PyBytes_FromStringAndSize((const char *)payload, (Py_ssize_t)header->payload_bytes),
    };
    int failed = 0;
    for (int n = 0; n < 8; n++) {
        failed |= !values[n];
        PyTuple_SetItem(record, n, values[n]);
    }
    if (failed) Py_CLEAR(record);
    return record;
}

/* Append the records from `offset` on to the list. Return 0 where a frame is not mine, or no more are asked for; -1 on
 * an error. The collector is off, so nothing else runs meanwhile. */
static int take(Reading *reading, const Py_buffer *buffer, size_t *offset, uint32_t salt, uint64_t *position,
                uint64_t until, uint64_t *total, uint64_t bytes_max, PyTypeObject *kind, PyObject *records,
                PyObject *checksums) {
    size_t end = (size_t)buffer->len;
    int is_first = records == Py_None || PyList_Size(records) == 0;
    while (*position < until) {
        Header header;
        if (*offset > end || end - *offset < sizeof header) return 0;
        const uint8_t *frame = (const uint8_t *)buffer->buf + *offset, *body = frame + sizeof header;
        memcpy(&header, frame, sizeof header);
        size_t body_bytes = padded((size_t)header.type_bytes + header.payload_bytes);
        if (header.salt != salt || body_bytes > end - *offset - sizeof header) return 0;
        if (crc32((uint8_t *)&header, CHECKED, crc32(body, body_bytes, 0)) != header.checksum) return 0;
        if (header.kind == EVENT) {
            if (header.position != *position + 1) return 0;
            if (*total + header.payload_bytes > bytes_max && !is_first) return 0;
            PyObject *type = type_of(reading, body, header.type_bytes);
            if (!type) return PyErr_Occurred() ? -1 : 0;
            int is_ready = begin_episode(reading, &header);
            if (is_ready <= 0) return is_ready;
            if (reading->opened) {
                int is_end = header.type_bytes == 12 && !memcmp(body, "EpisodeEnded", 12);
                if (is_end || header.sequence != reading->last.sequence + 1) return 0;
                PyObject *checksum = PyLong_FromUnsignedLong(header.checksum);
                int failed = !checksum || PyList_Append(checksums, checksum) < 0;
                Py_XDECREF(checksum);
                if (failed) return -1;
                reading->last = header;
                reading->is_changed = 1;
            }
            if (records != Py_None) {
                PyObject *record = record_of(kind, &header, reading->episode, type, body + header.type_bytes);
                int failed = !record || PyList_Append(records, record) < 0;
                Py_XDECREF(record);
                if (failed) return -1;
            }
            *position = header.position;
            *total += header.payload_bytes;
            is_first = 0;
        } else if (header.kind != COMMIT || reading->opened) {
            return 0;
        }
        *offset += sizeof header + body_bytes;
    }
    return 0;
}

/* take_records(buffer, offset, salt, position, until, total, bytes_max, types, kind, records, opened, checksums)
 * -> (offset, position, total) */
static PyObject *take_records(PyObject *Py_UNUSED(module), PyObject *arguments) {
    PyObject *of, *kind, *records, *opened, *checksums;
    Py_ssize_t start;
    unsigned int salt;
    unsigned long long first, until, bytes, bytes_max;
    Reading reading = {0};
    if (!PyArg_ParseTuple(arguments, "OnIKKKKO!O!OOO", &of, &start, &salt, &first, &until, &bytes, &bytes_max,
                          &PyDict_Type, &reading.types, &PyType_Type, &kind, &records, &opened, &checksums))
        return NULL;
    Py_buffer buffer;
    if (PyObject_GetBuffer(of, &buffer, PyBUF_SIMPLE) < 0) return NULL;
    reading.opened = opened == Py_None ? NULL : opened;
    size_t offset = (size_t)start;
    uint64_t position = first, total = bytes;
    int collects = PyGC_Disable();
    int failed = take(&reading, &buffer, &offset, salt, &position, until, &total, bytes_max, (PyTypeObject *)kind,
                      records, checksums);
    if (reading.opened && !failed) failed = note_last(&reading);
    if (collects) PyGC_Enable();
    Py_XDECREF(reading.episode);
    PyBuffer_Release(&buffer);
    return failed ? NULL : Py_BuildValue("(nKK)", (Py_ssize_t)offset, position, total);
}

/* === store ===================================================================================================== */

/* event_values(records, number) -> the values of the events' rows, one row after the other */
static PyObject *event_values(PyObject *Py_UNUSED(module), PyObject *arguments) {
    enum { COLUMNS = 7 };
    PyObject *records, *number;
    if (!PyArg_ParseTuple(arguments, "O!O", &PyList_Type, &records, &number)) return NULL;
    Py_ssize_t count = PyList_Size(records);
    PyObject *values = PyTuple_New(COLUMNS * count);
    for (Py_ssize_t at = 0; values && at < count; at++) {
        PyObject *record = PyList_GetItem(records, at), *payload = record ? PyTuple_GetItem(record, COLUMNS) : NULL;
        char *bytes;
        Py_ssize_t size;
        if (!payload || PyBytes_AsStringAndSize(payload, &bytes, &size) < 0) goto failed;
        PyObject *text = PyUnicode_DecodeUTF8(bytes, size, NULL);
        if (!text) goto failed;
        PyTuple_SetItem(values, COLUMNS * at, Py_NewRef(number));
        for (int n = 2; n < COLUMNS; n++) /* from the sequence to the monotonic time */
            PyTuple_SetItem(values, COLUMNS * at + n - 1, Py_NewRef(PyTuple_GetItem(record, n)));
        PyTuple_SetItem(values, COLUMNS * at + COLUMNS - 1, text);
    }
    return values;

failed:
    Py_DECREF(values);
    return NULL;
}

static uint8_t *put(uint8_t *at, uint64_t value, Py_ssize_t size) { /* big endian */
    for (Py_ssize_t n = size; n--; value >>= 8) at[n] = (uint8_t)value;
    return at + size;
}

/* copy_rows(records, number, sizes) -> the events' rows in PostgreSQL's binary format of COPY; the columns have these
 * sizes in bytes, and -1 is that of a text */
static PyObject *copy_rows(PyObject *Py_UNUSED(module), PyObject *arguments) {
    enum { COLUMNS = 7, TYPE = 2 };
    PyObject *records, *rows = NULL;
    long long number;
    int sizes[COLUMNS];
    if (!PyArg_ParseTuple(arguments, "O!L(iiiiiii)", &PyList_Type, &records, &number, sizes, sizes + 1, sizes + 2,
                          sizes + 3, sizes + 4, sizes + 5, sizes + 6))
        return NULL;
    for (int writes = 0; writes < 2; writes++) { /* the first round adds up the sizes */
        uint8_t *at = writes ? (uint8_t *)PyBytes_AsString(rows) : NULL;
        Py_ssize_t count = PyList_Size(records), total = 0;
        for (Py_ssize_t row = 0; row < count; row++) {
            PyObject *record = PyList_GetItem(records, row);
            if (writes) at = put(at, COLUMNS, 2);
            total += 2;
            for (int n = 0; n < COLUMNS; n++) {
                PyObject *item = n ? PyTuple_GetItem(record, n + 1) : NULL;
                Py_ssize_t size = sizes[n];
                long long value = number;
                char *text = NULL;
                if (n && !item) goto failed;
                if (size > 0)
                    value = n ? PyLong_AsLongLong(item) : number;
                else if (n == TYPE)
                    text = (char *)PyUnicode_AsUTF8AndSize(item, &size);
                else
                    PyBytes_AsStringAndSize(item, &text, &size);
                if (size == 4 && !text && value != (int32_t)value)
                    PyErr_SetString(PyExc_OverflowError, "a value of a record does not fit its column");
                if (PyErr_Occurred()) goto failed;
                total += 4 + size;
                if (!writes) continue;
                at = put(at, (uint64_t)size, 4);
                if (text) memcpy(at, text, (size_t)size), at += size;
                else at = put(at, (uint64_t)value, size);
            }
        }
        if (!writes && !(rows = PyBytes_FromStringAndSize(NULL, total))) return NULL;
    }
    return rows;

failed:
    Py_XDECREF(rows);
    return NULL;
}

/* row_values(rows, null) -> the values of the rows, one row after the other, with `null` for None and 0 and 1 for
 * booleans */
static PyObject *row_values(PyObject *Py_UNUSED(module), PyObject *arguments) {
    PyObject *rows, *null;
    if (!PyArg_ParseTuple(arguments, "O!O", &PyList_Type, &rows, &null)) return NULL;
    Py_ssize_t count = PyList_Size(rows), columns = count ? PySequence_Size(PyList_GetItem(rows, 0)) : 0;
    if (columns < 0) return NULL;
    PyObject *zero = PyLong_FromLong(0), *one = PyLong_FromLong(1), *values = PyTuple_New(columns * count);
    int failed = !zero || !one || !values;
    for (Py_ssize_t at = 0; !failed && at < count; at++) {
        PyObject *row = PySequence_Tuple(PyList_GetItem(rows, at));
        failed = !row || PyTuple_Size(row) != columns;
        if (row && failed) PyErr_SetString(PyExc_ValueError, "the rows differ in length");
        for (Py_ssize_t n = 0; !failed && n < columns; n++) {
            PyObject *value = PyTuple_GetItem(row, n);
            value = value == Py_None ? null : value == Py_False ? zero : value == Py_True ? one : value;
            PyTuple_SetItem(values, columns * at + n, Py_NewRef(value));
        }
        Py_XDECREF(row);
    }
    Py_XDECREF(zero);
    Py_XDECREF(one);
    if (failed) Py_CLEAR(values);
    return values;
}

/* === module ==================================================================================================== */

#ifndef SOURCE
#define SOURCE "" /* the SHA-256 of this file, for the tests */
#endif

static PyObject *py_crc32(PyObject *Py_UNUSED(module), PyObject *arguments) { /* for the tests */
    Py_buffer content;
    int folds = 1;
    if (!PyArg_ParseTuple(arguments, "y*|p", &content, &folds)) return NULL;
    uint32_t crc = folds ? crc32(content.buf, (size_t)content.len, 0)
                         : ~crc_by_tables(content.buf, (size_t)content.len, ~0u);
    PyBuffer_Release(&content);
    return PyLong_FromUnsignedLong(crc);
}

static PyMethodDef methods[] = {
    {"take_records", take_records, METH_VARARGS, NULL},
    {"event_values", event_values, METH_VARARGS, NULL},
    {"copy_rows", copy_rows, METH_VARARGS, NULL},
    {"row_values", row_values, METH_VARARGS, NULL},
    {"crc32", py_crc32, METH_VARARGS, NULL},
    {0}};

static int fill_module(PyObject *module) {
    make_tables();
#if defined(__x86_64__)
    can_fold = __builtin_cpu_supports("pclmul");
#endif
    PyObject *tail = PyType_FromSpec(&Tail_spec);
    int failed = !tail || PyModule_AddObjectRef(module, "Tail", tail) < 0;
    failed |= PyModule_AddStringConstant(module, "SOURCE", SOURCE) < 0;
    Py_XDECREF(tail);
    return failed ? -1 : 0;
}

static PyModuleDef_Slot slots[] = {{Py_mod_exec, (void *)fill_module}, {0, NULL}};
static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_core", NULL, 0, methods, slots, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__core(void) { return PyModuleDef_Init(&definition); }
