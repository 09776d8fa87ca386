// A DDS peer on Cyclone DDS 0.10: publishes and subscribes serialized samples of any type, says and decodes messages
// of a few types that it knows, and shows the ROS graph.
#include <dds/dds.h>
#include <dds/ddsi/ddsi_serdata.h>
#include <dds/ddsi/ddsi_sertype.h>
#include <dds/ddsi/q_radmin.h>
#include <dds/version.h>
#include <poll.h>
#include <unistd.h>

#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <new>

#include "common.hpp"
#include "messages.hpp"

namespace {

[[noreturn]] void fail(const std::string& what, dds_return_t code) {
  emit_error(what + ": " + dds_strretcode(code));
  std::exit(1);
}

dds_entity_t check(const std::string& what, dds_entity_t entity) {
  if (entity < 0) fail(what, entity);
  return entity;
}

// A type whose samples are `Bytes` in memory and the very same bytes on the wire, encapsulation header included.
// It is keyless, and carries no XTypes information, so that only its name has to match.
struct RawSample : ddsi_serdata {
  Bytes bytes;   // with up to three zeros after `count`: Cyclone sends whole words
  uint32_t count = 0;

  RawSample(const ddsi_sertype* type, ddsi_serdata_kind kind, size_t count_) : bytes((count_ + 3) / 4 * 4, 0) {
    count = static_cast<uint32_t>(count_);
    ddsi_serdata_init(this, type, kind);
    hash = type->serdata_basehash;
  }
};

RawSample* raw(ddsi_serdata* sample) { return static_cast<RawSample*>(sample); }
const RawSample* raw(const ddsi_serdata* sample) { return static_cast<const RawSample*>(sample); }

bool same_key(const ddsi_serdata*, const ddsi_serdata*) { return true; }

uint32_t size_of(const ddsi_serdata* sample) { return raw(sample)->count; }

ddsi_serdata* from_fragments(const ddsi_sertype* type, ddsi_serdata_kind kind, const nn_rdata* fragment, size_t size) {
  auto* sample = new RawSample(type, kind, size);
  uint32_t have = 0;
  for (; fragment != nullptr; fragment = fragment->nextfrag) {
    if (fragment->min > have || fragment->maxp1 > size) {
      delete sample;
      return nullptr;
    }
    if (fragment->maxp1 > have) {  // fragments may overlap
      const unsigned char* payload = NN_RMSG_PAYLOADOFF(fragment->rmsg, NN_RDATA_PAYLOAD_OFF(fragment));
      std::memcpy(sample->bytes.data() + have, payload + (have - fragment->min), fragment->maxp1 - have);
      have = fragment->maxp1;
    }
  }
  return sample;
}

ddsi_serdata* from_pieces(const ddsi_sertype* type, ddsi_serdata_kind kind, ddsrt_msg_iovlen_t count,
                          const ddsrt_iovec_t* pieces, size_t size) {
  auto* sample = new RawSample(type, kind, size);
  size_t have = 0;
  for (ddsrt_msg_iovlen_t at = 0; at < count && have < size; ++at) {
    const size_t part = std::min<size_t>(pieces[at].iov_len, size - have);
    std::memcpy(sample->bytes.data() + have, pieces[at].iov_base, part);
    have += part;
  }
  return sample;
}

ddsi_serdata* from_keyhash(const ddsi_sertype* type, const ddsi_keyhash*) { return new RawSample(type, SDK_KEY, 0); }

ddsi_serdata* from_sample(const ddsi_sertype* type, ddsi_serdata_kind kind, const void* data) {
  const auto& bytes = *static_cast<const Bytes*>(data);
  auto* sample = new RawSample(type, kind, kind == SDK_DATA ? bytes.size() : 0);
  if (kind == SDK_DATA && !bytes.empty()) std::memcpy(sample->bytes.data(), bytes.data(), bytes.size());
  return sample;
}

void to_bytes(const ddsi_serdata* sample, size_t offset, size_t count, void* buffer) {
  std::memcpy(buffer, raw(sample)->bytes.data() + offset, count);
}

ddsi_serdata* lend_bytes(const ddsi_serdata* sample, size_t offset, size_t count, ddsrt_iovec_t* piece) {
  piece->iov_base = const_cast<uint8_t*>(raw(sample)->bytes.data()) + offset;
  piece->iov_len = static_cast<ddsrt_iov_len_t>(count);
  return ddsi_serdata_ref(sample);
}

void return_bytes(ddsi_serdata* sample, const ddsrt_iovec_t*) { ddsi_serdata_unref(sample); }

bool to_sample(const ddsi_serdata* sample, void* data, void**, void*) {
  const RawSample* source = raw(sample);
  static_cast<Bytes*>(data)->assign(source->bytes.begin(), source->bytes.begin() + source->count);
  return true;
}

ddsi_serdata* to_untyped(const ddsi_serdata* sample) { return new RawSample(sample->type, SDK_KEY, 0); }

bool untyped_to_sample(const ddsi_sertype*, const ddsi_serdata*, void*, void**, void*) { return true; }

void free_sample(ddsi_serdata* sample) { delete raw(sample); }

size_t print_sample(const ddsi_sertype*, const ddsi_serdata*, char* buffer, size_t size) {
  if (size > 0) buffer[0] = '\0';
  return 0;
}

void keyhash_of(const ddsi_serdata*, ddsi_keyhash* keyhash, bool) { std::memset(keyhash, 0, sizeof *keyhash); }

void free_type(ddsi_sertype* type) {
  ddsi_sertype_fini(type);
  delete type;
}

void zero_samples(const ddsi_sertype*, void* samples, size_t count) {
  for (size_t at = 0; at < count; ++at) static_cast<Bytes*>(samples)[at].clear();
}

// Cyclone asks for memory of samples only in dds_read and dds_take, which the raw topics here never use.
void realloc_samples(void**, const ddsi_sertype*, void*, size_t, size_t) { std::abort(); }
void free_samples(const ddsi_sertype*, void**, size_t, dds_free_op_t) {}
bool same_type(const ddsi_sertype*, const ddsi_sertype*) { return true; }
uint32_t hash_of_type(const ddsi_sertype*) { return 0; }

ddsi_sertype* raw_type(const std::string& name) {
  static ddsi_serdata_ops sample_ops{};
  sample_ops.eqkey = same_key;
  sample_ops.get_size = size_of;
  sample_ops.from_ser = from_fragments;
  sample_ops.from_ser_iov = from_pieces;
  sample_ops.from_keyhash = from_keyhash;
  sample_ops.from_sample = from_sample;
  sample_ops.to_ser = to_bytes;
  sample_ops.to_ser_ref = lend_bytes;
  sample_ops.to_ser_unref = return_bytes;
  sample_ops.to_sample = to_sample;
  sample_ops.to_untyped = to_untyped;
  sample_ops.untyped_to_sample = untyped_to_sample;
  sample_ops.free = free_sample;
  sample_ops.print = print_sample;
  sample_ops.get_keyhash = keyhash_of;
  static ddsi_sertype_ops type_ops{};
  type_ops.version = ddsi_sertype_v0;
  type_ops.free = free_type;
  type_ops.zero_samples = zero_samples;
  type_ops.realloc_samples = realloc_samples;
  type_ops.free_samples = free_samples;
  type_ops.equal = same_type;
  type_ops.hash = hash_of_type;
  auto* type = new ddsi_sertype{};
  ddsi_sertype_init(type, name.c_str(), &type_ops, &sample_ops, true);
  type->allowed_data_representation = DDS_DATA_REPRESENTATION_FLAG_XCDR1;
  return type;
}

dds_entity_t raw_topic(dds_entity_t participant, const std::string& topic, const std::string& type_name) {
  ddsi_sertype* type = raw_type(type_name);
  return check("topic", dds_create_topic_sertype(participant, topic.c_str(), &type, nullptr, nullptr, nullptr));
}

dds_qos_t* qos_of(const Options& options) {
  dds_qos_t* qos = dds_create_qos();
  dds_qset_reliability(qos, options.reliable ? DDS_RELIABILITY_RELIABLE : DDS_RELIABILITY_BEST_EFFORT,
                       static_cast<dds_duration_t>(options.max_blocking_s * 1e9));
  dds_qset_durability(qos, options.transient_local ? DDS_DURABILITY_TRANSIENT_LOCAL : DDS_DURABILITY_VOLATILE);
  const bool keep_all = options.history_depth == 0;
  dds_qset_history(qos, keep_all ? DDS_HISTORY_KEEP_ALL : DDS_HISTORY_KEEP_LAST, keep_all ? 1 : options.history_depth);
  if (options.transient_local) {
    dds_qset_durability_service(qos, 0, keep_all ? DDS_HISTORY_KEEP_ALL : DDS_HISTORY_KEEP_LAST,
                                keep_all ? 1 : options.history_depth, DDS_LENGTH_UNLIMITED, DDS_LENGTH_UNLIMITED,
                                DDS_LENGTH_UNLIMITED);
  }
  if (options.max_samples > 0) {
    dds_qset_resource_limits(qos, options.max_samples, DDS_LENGTH_UNLIMITED, options.max_samples);
  }
  return qos;
}

template <typename Status>
void emit_match(const Status& status) {
  emit("{\"event\":\"matched\",\"current\":" + std::to_string(status.current_count) +
       ",\"change\":" + std::to_string(status.current_count_change) + "}");
}

void emit_incompatible(uint32_t policy_id) {
  emit("{\"event\":\"incompatible_qos\",\"policy_id\":" + std::to_string(policy_id) + "}");
}

dds_listener_t* listener() {
  dds_listener_t* listener = dds_create_listener(nullptr);
  dds_lset_publication_matched(
      listener, [](dds_entity_t, dds_publication_matched_status_t status, void*) { emit_match(status); });
  dds_lset_subscription_matched(
      listener, [](dds_entity_t, dds_subscription_matched_status_t status, void*) { emit_match(status); });
  dds_lset_offered_incompatible_qos(listener, [](dds_entity_t, dds_offered_incompatible_qos_status_t status, void*) {
    emit_incompatible(status.last_policy_id);
  });
  dds_lset_requested_incompatible_qos(
      listener,
      [](dds_entity_t, dds_requested_incompatible_qos_status_t status, void*) { emit_incompatible(status.last_policy_id); });
  return listener;
}

void wait_for_readers(const Options& options, dds_entity_t writer) {
  while (!stop_requested && options.wait_match > 0) {
    dds_publication_matched_status_t status{};
    dds_get_publication_matched_status(writer, &status);
    if (status.current_count >= static_cast<uint32_t>(options.wait_match)) break;
    sleep_until(monotonic_ns() + 10'000'000);
  }
}

int publish(const Options& options, dds_entity_t participant) {
  dds_qos_t* qos = qos_of(options);
  const dds_entity_t topic = raw_topic(participant, options.topic, options.type);
  const dds_entity_t writer = check("writer", dds_create_writer(participant, topic, qos, listener()));
  emit_ready("Cyclone DDS " DDS_VERSION);
  wait_for_readers(options, writer);
  Publisher publisher(options);
  const auto write = [&](const Bytes& bytes, int64_t source_ns) {
    return dds_write_ts(writer, &bytes, source_ns) == DDS_RETCODE_OK;
  };
  const auto acknowledged = [&](int64_t timeout_ns) { return dds_wait_for_acks(writer, timeout_ns) == DDS_RETCODE_OK; };
  publisher.begin(write, acknowledged);
  publisher.run(write);
  publisher.linger(acknowledged);
  publisher.print_summary();
  return 0;
}

// Calls `take(line)` for each line of stdin, until its end or a signal.
template <typename Take>
void read_lines(Take take) {
  std::string text;
  std::vector<char> buffer(1 << 16);
  while (!stop_requested) {
    pollfd input{STDIN_FILENO, POLLIN, 0};
    if (poll(&input, 1, 100) <= 0) continue;
    const ssize_t count = read(STDIN_FILENO, buffer.data(), buffer.size());
    if (count < 0 && errno == EINTR) continue;
    if (count <= 0) break;
    size_t begin = 0;
    size_t end = text.size();
    text.append(buffer.data(), static_cast<size_t>(count));
    while ((end = text.find('\n', end)) != std::string::npos) {
      take(text.substr(begin, end - begin));
      begin = ++end;
    }
    text.erase(0, begin);
  }
}

// Publishes each line of stdin.
int say(const Options& options, dds_entity_t participant) {
  const Message& message = *message_named("string");
  const dds_entity_t topic =
      check("topic", dds_create_topic(participant, message.descriptor, options.topic.c_str(), nullptr, nullptr));
  const dds_entity_t writer = check("writer", dds_create_writer(participant, topic, qos_of(options), listener()));
  emit_ready("Cyclone DDS " DDS_VERSION);
  wait_for_readers(options, writer);
  uint64_t attempted = 0;
  uint64_t failed = 0;
  read_lines([&](const std::string& line) {
    const bool ok = write_string(writer, line) == DDS_RETCODE_OK;
    ++attempted;
    if (!ok) ++failed;
    if (!options.summary) emit(std::string("{\"event\":\"write\",\"ok\":") + (ok ? "true}" : "false}"));
  });
  const bool acknowledged = dds_wait_for_acks(writer, DDS_SECS(10)) == DDS_RETCODE_OK;
  emit(std::string("{\"event\":\"sent\",\"acknowledged\":") + (acknowledged ? "true}" : "false}"));
  sleep_until(monotonic_ns() + static_cast<int64_t>(options.linger_s * 1e9));
  emit("{\"event\":\"summary\",\"role\":\"pub\",\"attempted\":" + std::to_string(attempted) +
       ",\"ok\":" + std::to_string(attempted - failed) + ",\"failed\":" + std::to_string(failed) +
       ",\"acknowledged\":" + (acknowledged ? "true" : "false") + "}");
  return 0;
}

// Takes what a raw reader has: `take(bytes, count, source_ns)` for each sample.
template <typename Take>
void drain(dds_entity_t reader, Take take) {
  constexpr size_t batch = 64;
  ddsi_serdata* samples[batch];
  dds_sample_info_t infos[batch];
  for (;;) {
    const dds_return_t taken = dds_takecdr(reader, samples, batch, infos, DDS_ANY_STATE);
    if (taken < 0) fail("take", taken);
    for (dds_return_t at = 0; at < taken; ++at) {
      if (infos[at].valid_data) {
        const RawSample* sample = raw(samples[at]);
        take(sample->bytes.data(), static_cast<size_t>(sample->count), infos[at].source_timestamp);
      }
      ddsi_serdata_unref(samples[at]);
    }
    if (taken < static_cast<dds_return_t>(batch)) return;
  }
}

int subscribe(const Options& options, dds_entity_t participant) {
  dds_qos_t* qos = qos_of(options);
  const dds_entity_t topic = raw_topic(participant, options.topic, options.type);
  const dds_entity_t reader = check("reader", dds_create_reader(participant, topic, qos, listener()));
  const dds_entity_t waitset = check("waitset", dds_create_waitset(participant));
  check("attach", dds_waitset_attach(waitset, check("condition", dds_create_readcondition(reader, DDS_ANY_STATE)), 0));
  emit_ready("Cyclone DDS " DDS_VERSION);
  Subscriber subscriber(options);
  while (!subscriber.done()) {
    dds_waitset_wait(waitset, nullptr, 0, DDS_MSECS(100));
    drain(reader, [&](const uint8_t* bytes, size_t count, int64_t source_ns) {
      subscriber.take(bytes, count, source_ns);
    });
    subscriber.housekeeping();
  }
  subscriber.print_summary();
  return 0;
}

// Subscribes a message by its definition, and shows each sample that Cyclone DDS could decode.
int decode(const Options& options, dds_entity_t participant) {
  const Message* message = message_named(options.decode);
  if (message == nullptr) {
    emit_error("--decode " + options.decode + ": expected diagnostics or string");
    return 2;
  }
  const dds_entity_t topic =
      check("topic", dds_create_topic(participant, message->descriptor, options.topic.c_str(), nullptr, nullptr));
  const dds_entity_t reader = check("reader", dds_create_reader(participant, topic, qos_of(options), listener()));
  const dds_entity_t waitset = check("waitset", dds_create_waitset(participant));
  check("attach", dds_waitset_attach(waitset, check("condition", dds_create_readcondition(reader, DDS_ANY_STATE)), 0));
  emit_ready("Cyclone DDS " DDS_VERSION);
  const int64_t end_ns = monotonic_ns() + static_cast<int64_t>(options.duration_s * 1e9);
  uint64_t decoded = 0;
  while (!stop_requested && (options.duration_s == 0 || monotonic_ns() < end_ns) &&
         (options.count == 0 || decoded < options.count)) {
    dds_waitset_wait(waitset, nullptr, 0, DDS_MSECS(100));
    void* samples[1] = {nullptr};
    dds_sample_info_t info{};
    while (!stop_requested && dds_take(reader, samples, &info, 1, 1) == 1) {
      if (info.valid_data) {
        ++decoded;
        emit("{\"event\":\"decoded\",\"source_ns\":" + std::to_string(info.source_timestamp) +
             ",\"message\":" + message->json(samples[0]) + "}");
      }
      dds_return_loan(reader, samples, 1);
    }
  }
  emit("{\"event\":\"summary\",\"role\":\"sub\",\"decoded\":" + std::to_string(decoded) + "}");
  return 0;
}

// Reads CDR of rmw_dds_common/msg/ParticipantEntitiesInfo; every read past the end fails.
class CdrReader {
 public:
  CdrReader(const uint8_t* bytes, size_t count) : bytes_(bytes + 4), left_(count - 4), big_endian_(bytes[1] == 0) {}

  bool u32(uint32_t& value) {
    const size_t padding = (4 - at_ % 4) % 4;
    uint8_t word[4];
    if (padding > left_ || !skip(padding) || !copy(word, 4)) return false;
    value = big_endian_ ? static_cast<uint32_t>(word[0]) << 24 | word[1] << 16 | word[2] << 8 | word[3]
                        : static_cast<uint32_t>(word[3]) << 24 | word[2] << 16 | word[1] << 8 | word[0];
    return true;
  }

  bool text(std::string& value) {
    uint32_t length = 0;
    if (!u32(length) || length == 0 || length > left_) return false;
    value.assign(reinterpret_cast<const char*>(bytes_ + at_), length - 1);
    return skip(length);
  }

  bool gid(uint32_t bytes, std::string& value) {
    if (bytes > left_) return false;
    value = hex(bytes_ + at_, bytes);
    return skip(bytes);
  }

 private:
  bool skip(size_t count) {
    if (count > left_) return false;
    at_ += count;
    left_ -= count;
    return true;
  }
  bool copy(uint8_t* to, size_t count) {
    if (count > left_) return false;
    std::memcpy(to, bytes_ + at_, count);
    return skip(count);
  }

  const uint8_t* bytes_;
  size_t left_;
  size_t at_ = 0;
  bool big_endian_;
};

bool gid_list(CdrReader& cdr, uint32_t gid_bytes, std::string& json) {
  uint32_t count = 0;
  if (!cdr.u32(count)) return false;
  json = "[";
  for (uint32_t at = 0; at < count; ++at) {
    std::string gid;
    if (!cdr.gid(gid_bytes, gid)) return false;
    json += (at > 0 ? ",\"" : "\"") + gid + "\"";
  }
  json += "]";
  return true;
}

void emit_entities_info(const uint8_t* bytes, size_t count, uint32_t gid_bytes) {
  std::string gid;
  std::string nodes;
  uint32_t node_count = 0;
  bool good = count >= 4;
  if (good) {
    CdrReader cdr(bytes, count);
    good = cdr.gid(gid_bytes, gid) && cdr.u32(node_count);
    for (uint32_t at = 0; good && at < node_count; ++at) {
      std::string name_space, name, readers, writers;
      good = cdr.text(name_space) && cdr.text(name) && gid_list(cdr, gid_bytes, readers) &&
             gid_list(cdr, gid_bytes, writers);
      if (good) {
        nodes += std::string(at > 0 ? "," : "") + "{\"namespace\":" + json_string(name_space) +
                 ",\"name\":" + json_string(name) + ",\"reader_gids\":" + readers + ",\"writer_gids\":" + writers + "}";
      }
    }
  }
  if (good) {
    emit("{\"event\":\"participant_entities\",\"gid\":\"" + gid + "\",\"nodes\":[" + nodes + "]}");
  } else {
    emit("{\"event\":\"bad_participant_entities\",\"bytes\":\"" + hex(bytes, count) + "\"}");
  }
}

std::string guid_text(const dds_guid_t& guid) { return hex(guid.v, sizeof guid.v); }

std::string user_data_of(const dds_qos_t* qos) {
  void* bytes = nullptr;
  size_t count = 0;
  if (qos == nullptr || !dds_qget_userdata(qos, &bytes, &count) || bytes == nullptr) return "\"\"";
  const std::string text(static_cast<const char*>(bytes), count);
  dds_free(bytes);
  return json_string(text);
}

std::string qos_json(const dds_qos_t* qos) {
  dds_reliability_kind_t reliability = DDS_RELIABILITY_BEST_EFFORT;
  dds_duration_t max_blocking = 0;
  dds_durability_kind_t durability = DDS_DURABILITY_VOLATILE;
  dds_history_kind_t history = DDS_HISTORY_KEEP_LAST;
  int32_t depth = 0;
  dds_duration_t deadline = DDS_INFINITY;
  dds_qget_reliability(qos, &reliability, &max_blocking);
  dds_qget_durability(qos, &durability);
  const bool has_history = dds_qget_history(qos, &history, &depth);
  dds_qget_deadline(qos, &deadline);
  static const char* const durabilities[] = {"VOLATILE", "TRANSIENT_LOCAL", "TRANSIENT", "PERSISTENT"};
  std::string json = "{\"reliability\":\"";
  json += reliability == DDS_RELIABILITY_RELIABLE ? "RELIABLE" : "BEST_EFFORT";
  json += std::string("\",\"durability\":\"") + durabilities[durability] + "\"";
  if (has_history) {
    json += std::string(",\"history\":\"") + (history == DDS_HISTORY_KEEP_ALL ? "KEEP_ALL" : "KEEP_LAST") +
            "\",\"depth\":" + std::to_string(depth);
  }
  if (deadline != DDS_INFINITY) json += ",\"deadline_ms\":" + std::to_string(static_cast<double>(deadline) / 1e6);
  return json + ",\"user_data\":" + user_data_of(qos) + "}";
}

void drain_participants(dds_entity_t reader) {
  void* samples[1] = {nullptr};
  dds_sample_info_t info{};
  while (dds_take(reader, samples, &info, 1, 1) == 1) {
    const auto& participant = *static_cast<const dds_builtintopic_participant_t*>(samples[0]);
    const std::string guid = "\"guid\":\"" + guid_text(participant.key) + "\"";
    if (info.valid_data && info.instance_state == DDS_IST_ALIVE) {
      emit("{\"event\":\"participant\"," + guid + ",\"user_data\":" + user_data_of(participant.qos) + "}");
    } else {
      emit("{\"event\":\"participant_gone\"," + guid + "}");
    }
    dds_return_loan(reader, samples, 1);
  }
}

void drain_endpoints(dds_entity_t reader, const std::string& kind) {
  void* samples[1] = {nullptr};
  dds_sample_info_t info{};
  while (dds_take(reader, samples, &info, 1, 1) == 1) {
    const auto& endpoint = *static_cast<const dds_builtintopic_endpoint_t*>(samples[0]);
    const std::string who = "\"kind\":\"" + kind + "\",\"guid\":\"" + guid_text(endpoint.key) + "\"";
    if (info.valid_data && info.instance_state == DDS_IST_ALIVE) {
      emit("{\"event\":\"endpoint\"," + who + ",\"participant\":\"" + guid_text(endpoint.participant_key) +
           "\",\"topic\":" + json_string(endpoint.topic_name) + ",\"type\":" + json_string(endpoint.type_name) +
           ",\"qos\":" + qos_json(endpoint.qos) + "}");
    } else {
      emit("{\"event\":\"endpoint_gone\"," + who + "}");
    }
    dds_return_loan(reader, samples, 1);
  }
}

// Shows every participant and endpoint that discovery finds, and every graph entry.
int show_graph(const Options& options, dds_entity_t participant) {
  const dds_entity_t participants =
      check("builtin", dds_create_reader(participant, DDS_BUILTIN_TOPIC_DCPSPARTICIPANT, nullptr, nullptr));
  const dds_entity_t writers =
      check("builtin", dds_create_reader(participant, DDS_BUILTIN_TOPIC_DCPSPUBLICATION, nullptr, nullptr));
  const dds_entity_t readers =
      check("builtin", dds_create_reader(participant, DDS_BUILTIN_TOPIC_DCPSSUBSCRIPTION, nullptr, nullptr));
  // The QoS of rmw_dds_common's graph cache, but for the reader's history: one entry comes from each participant, and
  // as the topic has no key a KEEP_LAST 1 reader would lose all but the latest.
  dds_qos_t* qos = dds_create_qos();
  dds_qset_reliability(qos, DDS_RELIABILITY_RELIABLE, DDS_SECS(1));
  dds_qset_durability(qos, DDS_DURABILITY_TRANSIENT_LOCAL);
  dds_qset_history(qos, DDS_HISTORY_KEEP_ALL, DDS_LENGTH_UNLIMITED);
  const dds_entity_t topic =
      raw_topic(participant, "ros_discovery_info", "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_");
  const dds_entity_t entries = check("reader", dds_create_reader(participant, topic, qos, nullptr));

  const dds_entity_t waitset = check("waitset", dds_create_waitset(participant));
  for (const dds_entity_t reader : {participants, writers, readers, entries}) {
    check("attach", dds_waitset_attach(waitset, check("condition", dds_create_readcondition(reader, DDS_ANY_STATE)), 0));
  }
  emit_ready("Cyclone DDS " DDS_VERSION);
  const int64_t end_ns = monotonic_ns() + static_cast<int64_t>(options.duration_s * 1e9);
  while (!stop_requested && (options.duration_s == 0 || monotonic_ns() < end_ns)) {
    dds_waitset_wait(waitset, nullptr, 0, DDS_MSECS(100));
    drain_participants(participants);
    drain_endpoints(writers, "writer");
    drain_endpoints(readers, "reader");
    drain(entries, [&](const uint8_t* bytes, size_t count, int64_t) {
      emit_entities_info(bytes, count, options.gid_bytes);
    });
  }
  emit("{\"event\":\"summary\",\"role\":\"graph\"}");
  return 0;
}

// Used unless CYCLONEDDS_URI says otherwise: one interface if asked, and room for bursts of fragments.
std::string configuration(const Options& options) {
  std::string xml = "<General>";
  if (!options.interface_ip.empty()) {
    xml += "<Interfaces><NetworkInterface address=\"" + options.interface_ip + "\"/></Interfaces>";
  }
  return xml + "</General><Internal><SocketReceiveBufferSize max=\"4MiB\"/></Internal>";
}

}  // namespace

int main(int argc, char** argv) {
  const Options options = parse_options(argc, argv);
  handle_signals();
  setenv("CYCLONEDDS_URI", configuration(options).c_str(), 0);
  const dds_entity_t participant = check("participant", dds_create_participant(options.domain, nullptr, nullptr));
  int code = 0;
  if (options.say) code = say(options, participant);
  else if (!options.decode.empty()) code = decode(options, participant);
  else if (options.role == "pub") code = publish(options, participant);
  else if (options.role == "sub") code = subscribe(options, participant);
  else code = show_graph(options, participant);
  dds_delete(participant);
  return code;
}
