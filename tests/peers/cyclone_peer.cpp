// A DDS peer on Cyclone DDS 0.10: publishes and subscribes serialized samples of any type, says and decodes messages
// of a few types that it knows, shows the ROS graph, and calls services as rmw_cyclonedds does.
#include <dds/dds.h>
#include <dds/version.h>
#include <poll.h>
#include <unistd.h>

#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <new>

#include "common.hpp"
#include "cyclone_raw.hpp"
#include "messages.hpp"

namespace {

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
  dds_qset_writer_data_lifecycle(qos, false);  // unregistered is not disposed
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
  if (options.keys > 2) {
    const Bytes disposed = key_sample(1);
    const Bytes unregistered = key_sample(2);
    check("dispose", dds_dispose(writer, &disposed));
    check("unregister", dds_unregister_instance(writer, &unregistered));
  }
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
    const auto take = [&](const uint8_t* bytes, size_t count, int64_t source_ns) {
      subscriber.take(bytes, count, source_ns);
    };
    const auto state = [&](uint32_t key, dds_instance_state_t state) {
      if (options.keys == 0) return;
      subscriber.state(key, state == DDS_IST_ALIVE                ? "alive"
                            : state == DDS_IST_NOT_ALIVE_DISPOSED ? "disposed"
                                                                  : "no_writers");
    };
    drain(reader, take, state);
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
  dds_duration_t lifespan = DDS_INFINITY;
  dds_qget_lifespan(qos, &lifespan);
  static const char* const durabilities[] = {"VOLATILE", "TRANSIENT_LOCAL", "TRANSIENT", "PERSISTENT"};
  std::string json = "{\"reliability\":\"";
  json += reliability == DDS_RELIABILITY_RELIABLE ? "RELIABLE" : "BEST_EFFORT";
  json += std::string("\",\"durability\":\"") + durabilities[durability] + "\"";
  if (has_history) {
    json += std::string(",\"history\":\"") + (history == DDS_HISTORY_KEEP_ALL ? "KEEP_ALL" : "KEEP_LAST") +
            "\",\"depth\":" + std::to_string(depth);
  }
  if (deadline != DDS_INFINITY) json += ",\"deadline_ms\":" + std::to_string(static_cast<double>(deadline) / 1e6);
  if (lifespan != DDS_INFINITY) json += ",\"lifespan_ms\":" + std::to_string(static_cast<double>(lifespan) / 1e6);
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

// In front of the payload of each request and each reply, in the encoding of rmw_cyclonedds. `client` is the instance
// handle of the client's writer; a client takes only replies with its own.
struct ServiceHeader {
  uint64_t client = 0;
  int64_t number = 0;
};

// Calls a service: each line of stdin is a request in hexadecimal, as little-endian CDR without the encapsulation
// header; the next is sent after the reply.
int call_service(const Options& options, dds_entity_t participant) {
  // Topics, types, QoS and USER_DATA as in rmw_init_cs of rmw_cyclonedds; the id is any that is unique.
  dds_qos_t* qos = qos_of(options);
  dds_guid_t guid;
  check("guid", dds_get_guid(participant, &guid));
  const std::string user_data = "clientid=" + guid_text(guid) + ";";
  dds_qset_userdata(qos, user_data.data(), user_data.size());
  const dds_entity_t requests = raw_topic(participant, "rq/" + options.topic + "Request", options.type + "_Request_");
  const dds_entity_t replies = raw_topic(participant, "rr/" + options.topic + "Reply", options.type + "_Response_");
  const dds_entity_t writer = check("writer", dds_create_writer(participant, requests, qos, listener()));
  const dds_entity_t reader = check("reader", dds_create_reader(participant, replies, qos, listener()));
  const dds_entity_t waitset = check("waitset", dds_create_waitset(participant));
  check("attach", dds_waitset_attach(waitset, check("condition", dds_create_readcondition(reader, DDS_ANY_STATE)), 0));
  constexpr size_t begin = 4 + sizeof(ServiceHeader);
  ServiceHeader header;
  check("instance handle", dds_get_instance_handle(writer, &header.client));
  emit_ready("Cyclone DDS " DDS_VERSION);
  // As rmw_service_server_is_available for a service that announces no id.
  for (bool available = false; !available && !stop_requested; sleep_until(monotonic_ns() + 10'000'000)) {
    dds_publication_matched_status_t readers{};
    dds_subscription_matched_status_t writers{};
    dds_get_publication_matched_status(writer, &readers);
    dds_get_subscription_matched_status(reader, &writers);
    available = readers.current_count > 0 && writers.current_count > 0;
  }
  read_lines([&](const std::string& line) {
    ++header.number;
    const Bytes body = hex_bytes(line);
    Bytes request(begin + body.size());
    request[1] = 1;  // the encapsulation header of little-endian CDR
    std::memcpy(request.data() + 4, &header, sizeof header);
    std::copy(body.begin(), body.end(), request.begin() + begin);
    check("write", dds_write(writer, &request));
    for (bool answered = false; !answered && !stop_requested;) {
      dds_waitset_wait(waitset, nullptr, 0, DDS_MSECS(100));
      drain(reader, [&](const uint8_t* bytes, size_t count, int64_t) {
        ServiceHeader of;
        if (count < begin) return emit_error("a reply of " + std::to_string(count) + " bytes");
        std::memcpy(&of, bytes + 4, sizeof of);
        if (of.client != header.client) return emit("{\"event\":\"reply_of_another\"}");
        answered |= of.number == header.number;
        emit("{\"event\":\"reply\",\"number\":" + std::to_string(of.number) + ",\"encapsulation\":\"" + hex(bytes, 4) +
             "\",\"body\":\"" + hex(bytes + begin, count - begin) + "\"}");
      });
    }
  });
  emit("{\"event\":\"summary\",\"role\":\"client\"}");
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
  raw_keys = options.keys;
  handle_signals();
  setenv("CYCLONEDDS_URI", configuration(options).c_str(), 0);
  const dds_entity_t participant = check("participant", dds_create_participant(options.domain, nullptr, nullptr));
  int code = 0;
  if (options.say) code = say(options, participant);
  else if (!options.decode.empty()) code = decode(options, participant);
  else if (options.role == "pub") code = publish(options, participant);
  else if (options.role == "sub") code = subscribe(options, participant);
  else if (options.role == "client") code = call_service(options, participant);
  else code = show_graph(options, participant);
  dds_delete(participant);
  return code;
}
