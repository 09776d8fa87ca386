#include "common.hpp"

#include <algorithm>
#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <fstream>
#include <iterator>
#include <mutex>

volatile std::sig_atomic_t stop_requested = 0;
volatile std::sig_atomic_t go_requested = 0;

namespace {

constexpr size_t header_bytes = 4;
constexpr size_t max_missing_ranges = 1000;
constexpr int64_t progress_period_ns = 100'000'000;

[[noreturn]] void usage(const std::string& problem) {
  std::fprintf(stderr, "%s (see tests/peers/README.md)\n", problem.c_str());
  std::exit(2);
}

double number(const std::string& name, const std::string& text, double max) {
  char* end = nullptr;
  const double value = std::strtod(text.c_str(), &end);
  if (text.empty() || *end != '\0' || !(value >= 0) || value > max) {
    usage(name + " " + text + ": expected a number from 0 to " + std::to_string(max));
  }
  return value;
}

uint64_t whole(const std::string& name, const std::string& text) {
  char* end = nullptr;
  errno = 0;
  const uint64_t value = std::strtoull(text.c_str(), &end, 10);
  if (text.empty() || text[0] == '-' || *end != '\0' || errno != 0) {
    usage(name + " " + text + ": expected a whole number");
  }
  return value;
}

bool choose(const std::string& name, const std::string& text, const char* no, const char* yes) {
  if (text != no && text != yes) usage(name + " " + text + ": expected " + no + " or " + yes);
  return text == yes;
}

std::vector<uint32_t> size_list(const std::string& text) {
  std::vector<uint32_t> sizes;
  size_t begin = 0;
  while (begin <= text.size()) {
    const size_t end = std::min(text.find(',', begin), text.size());
    const uint64_t size = whole("--size", text.substr(begin, end - begin));
    if (size > UINT32_C(1) << 30) usage("--size: at most 1 GiB");
    sizes.push_back(static_cast<uint32_t>(size));
    begin = end + 1;
  }
  return sizes;
}

Bytes encapsulation(const std::string& text) {
  if (text == "none") return {};
  if (text.size() != 2 * header_bytes) usage("--encap " + text + ": expected eight hexadecimal digits, or none");
  return hex_bytes(text);
}

uint64_t xorshift(uint64_t& state) {
  state ^= state << 13;
  state ^= state >> 7;
  state ^= state << 17;
  return state;
}

// Seeds xorshift so that neighbouring sequences share nothing (the finalizer of SplitMix64).
uint64_t scramble(uint64_t value) {
  value += 0x9e3779b97f4a7c15;
  value = (value ^ (value >> 30)) * 0xbf58476d1ce4e5b9;
  value = (value ^ (value >> 27)) * 0x94d049bb133111eb;
  return (value ^ (value >> 31)) | 1;  // xorshift never leaves 0
}

// Bytes 24 and on of the payload of that sequence.
void fill(uint8_t* bytes, size_t count, uint64_t seed, uint64_t seq) {
  uint64_t state = scramble(seed * 0x100000001b3 + seq);
  while (count > 0) {
    const uint64_t word = xorshift(state);
    const size_t part = std::min<size_t>(count, sizeof word);
    std::memcpy(bytes, &word, part);
    bytes += part;
    count -= part;
  }
}

// Of header and payload, padded with zeros to a multiple of four as RTPS does in a DATA submessage, so that both
// sides agree whether or not the padding is visible to the reader.
uint64_t hash_of(const uint8_t* bytes, size_t count) {
  uint64_t hash = 0xcbf29ce484222325 ^ ((count + 3) / 4);
  while (count > 0) {
    uint64_t word = 0;
    const size_t part = std::min<size_t>(count, sizeof word);
    std::memcpy(&word, bytes, part);
    hash = (hash ^ word) * 0x9ddfea08eb382d69;
    hash ^= hash >> 32;
    bytes += part;
    count -= part;
  }
  return hash;
}

std::string hash_text(uint64_t hash) {
  char text[17];
  std::snprintf(text, sizeof text, "%016llx", static_cast<unsigned long long>(hash));
  return text;
}

std::string microseconds(int64_t ns) {
  char text[32];
  std::snprintf(text, sizeof text, "%.1f", static_cast<double>(ns) / 1e3);
  return text;
}

// The order statistic at that fraction; `sorted` has at least one element.
int64_t quantile(const std::vector<int64_t>& sorted, double fraction) {
  return sorted[static_cast<size_t>(fraction * static_cast<double>(sorted.size() - 1) + 0.5)];
}

std::string distribution(std::vector<int64_t> ns) {
  if (ns.empty()) return "null";
  std::sort(ns.begin(), ns.end());
  return "{\"min\":" + microseconds(ns.front()) + ",\"p50\":" + microseconds(quantile(ns, 0.5)) +
         ",\"p95\":" + microseconds(quantile(ns, 0.95)) + ",\"p99\":" + microseconds(quantile(ns, 0.99)) +
         ",\"max\":" + microseconds(ns.back()) + "}";
}

// How many bytes the UTF-8 character at that place has; 0 when there is none (Unicode 15, table 3-7).
size_t character_bytes(const std::string& text, size_t at) {
  const auto byte = [&](size_t offset) {
    return at + offset < text.size() ? static_cast<unsigned char>(text[at + offset]) : 0u;
  };
  const auto in = [](unsigned value, unsigned low, unsigned high) { return value >= low && value <= high; };
  const unsigned lead = byte(0);
  if (lead < 0x80) return 1;
  size_t length = 0;
  unsigned low = 0x80, high = 0xbf;  // of the second byte
  if (in(lead, 0xc2, 0xdf)) length = 2;
  if (in(lead, 0xe0, 0xef)) length = 3;
  if (in(lead, 0xf0, 0xf4)) length = 4;
  if (lead == 0xe0) low = 0xa0;
  if (lead == 0xed) high = 0x9f;
  if (lead == 0xf0) low = 0x90;
  if (lead == 0xf4) high = 0x8f;
  for (size_t offset = 1; offset < length; ++offset) {
    if (!in(byte(offset), low, high)) return 0;
    low = 0x80, high = 0xbf;
  }
  return length;
}

void on_signal(int signal) { (signal == SIGUSR1 ? go_requested : stop_requested) = 1; }

int64_t clock_ns(clockid_t clock) {
  timespec now{};
  clock_gettime(clock, &now);
  return static_cast<int64_t>(now.tv_sec) * 1'000'000'000 + now.tv_nsec;
}

}  // namespace

Options parse_options(int argc, char** argv) {
  Options options;
  for (int at = 1; at < argc; ++at) {
    const std::string name = argv[at];
    if (name == "--summary") { options.summary = true; continue; }
    if (name == "--opaque") { options.opaque = true; continue; }
    if (name == "--hold") { options.hold = true; continue; }
    if (name == "--plain") { options.plain = true; continue; }
    if (name == "--prime") { options.prime = true; continue; }
    if (name == "--shm") { options.shared_memory = true; continue; }
    if (name == "--say") { options.say = true; continue; }
    if (at + 1 == argc) usage(name + ": unknown, or its value is missing");
    const std::string value = argv[++at];
    if (name == "--role") options.role = value;
    else if (name == "--domain") options.domain = static_cast<uint32_t>(number(name, value, 232));
    else if (name == "--topic") options.topic = value;
    else if (name == "--type") options.type = value;
    else if (name == "--reliability") options.reliable = choose(name, value, "be", "r");
    else if (name == "--durability") options.transient_local = choose(name, value, "v", "tl");
    else if (name == "--history") {
      options.history_depth = value == "all" ? 0 : static_cast<int32_t>(number(name, value, 1e6));
    }
    else if (name == "--max-samples") options.max_samples = static_cast<int32_t>(number(name, value, 1e6));
    else if (name == "--max-blocking-ms") options.max_blocking_s = number(name, value, 1e6) / 1e3;
    else if (name == "--keys") options.keys = static_cast<uint32_t>(number(name, value, 1e6));
    else if (name == "--interface") options.interface_ip = value == "none" ? "" : value;
    else if (name == "--rate") options.rate_hz = number(name, value, 1e6);
    else if (name == "--count") options.count = whole(name, value);
    else if (name == "--duration") options.duration_s = number(name, value, 1e6);
    else if (name == "--burst") options.burst = whole(name, value);
    else if (name == "--first-seq") options.first_seq = whole(name, value);
    else if (name == "--size") options.sizes = size_list(value);
    else if (name == "--seed") options.seed = whole(name, value);
    else if (name == "--encap") options.encapsulation = encapsulation(value);
    else if (name == "--payload-file") options.payload_file = value;
    else if (name == "--record") options.record_file = value;
    else if (name == "--source-age-ms") options.source_age_s = number(name, value, 1e9) / 1e3;
    else if (name == "--wait-match") options.wait_match = static_cast<int32_t>(number(name, value, 1e6));
    else if (name == "--heartbeat-ms") options.heartbeat_s = number(name, value, 1e6) / 1e3;
    else if (name == "--linger") options.linger_s = number(name, value, 1e6);
    else if (name == "--decode") options.decode = value;
    else if (name == "--stall-every") options.stall_every_s = number(name, value, 1e6);
    else if (name == "--stall-for") options.stall_for_s = number(name, value, 1e6);
    else if (name == "--gid-bytes") options.gid_bytes = choose(name, value, "16", "24") ? 24 : 16;
    else usage(name + ": unknown option");
  }
  if (options.role != "pub" && options.role != "sub" && options.role != "graph" && options.role != "client") {
    usage("--role: expected pub, sub, graph or client");
  }
  if (options.say && options.role != "pub") usage("--say: only of role pub");
  if (!options.decode.empty() && options.role != "sub") usage("--decode: only of role sub");
  if (options.role == "pub" && options.sizes.empty()) options.sizes = {2948};
  return options;
}

void handle_signals() {
  struct sigaction action {};
  action.sa_handler = on_signal;  // no SA_RESTART: a sleep is to end
  sigaction(SIGINT, &action, nullptr);
  sigaction(SIGTERM, &action, nullptr);
  sigaction(SIGUSR1, &action, nullptr);
}

int64_t monotonic_ns() { return clock_ns(CLOCK_MONOTONIC); }
int64_t realtime_ns() { return clock_ns(CLOCK_REALTIME); }

void sleep_until(int64_t at_ns) {
  // In slices: the signal may be handled on another thread of the library, which does not end this thread's sleep.
  while (!stop_requested) {
    const int64_t left_ns = at_ns - monotonic_ns();
    if (left_ns <= 0) return;
    const int64_t until_ns = left_ns > 100'000'000 ? monotonic_ns() + 100'000'000 : at_ns;
    timespec until{until_ns / 1'000'000'000, until_ns % 1'000'000'000};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, nullptr);
  }
}

void emit(const std::string& json) {
  static std::mutex mutex;
  const std::lock_guard<std::mutex> lock(mutex);
  std::fwrite(json.data(), 1, json.size(), stdout);
  std::fputc('\n', stdout);
  std::fflush(stdout);
}

void emit_error(const std::string& message) {
  emit("{\"event\":\"error\",\"message\":" + json_string(message) + "}");
}

void emit_ready(const std::string& library) {
  emit("{\"event\":\"ready\",\"library\":" + json_string(library) + "}");
}

Record::Record(const std::string& file, const char* header) {
  if (file.empty()) return;
  file_ = std::fopen(file.c_str(), "we");
  if (file_ == nullptr) usage("--record " + file + ": can't be written");
  std::setvbuf(file_, nullptr, _IOLBF, 256);
  std::fprintf(file_, "%s\n", header);
}

Record::~Record() {
  if (file_ != nullptr) std::fclose(file_);
}

void Record::row(uint64_t seq, int64_t time_ns, int64_t duration_ns) {
  if (file_ == nullptr) return;
  std::fprintf(file_, "%llu,%lld,%lld\n", static_cast<unsigned long long>(seq), static_cast<long long>(time_ns),
               static_cast<long long>(duration_ns));
}

void Record::row(uint64_t seq, int64_t time_ns, int64_t duration_ns, bool ok) {
  if (file_ == nullptr) return;
  std::fprintf(file_, "%llu,%lld,%lld,%d\n", static_cast<unsigned long long>(seq), static_cast<long long>(time_ns),
               static_cast<long long>(duration_ns), ok ? 1 : 0);
}

std::string json_string(const std::string& text) {
  std::string json = "\"";
  for (size_t at = 0; at < text.size();) {
    const size_t length = character_bytes(text, at);
    const auto code = static_cast<unsigned char>(text[at]);
    if (length == 0) {
      json += "\\ufffd";
    } else if (code == '"' || code == '\\') {
      json += '\\';
      json += text[at];
    } else if (code < 0x20 || code == 0x7f) {
      char escape[8];
      std::snprintf(escape, sizeof escape, "\\u%04x", code);
      json += escape;
    } else {
      json.append(text, at, length);
    }
    at += std::max<size_t>(length, 1);
  }
  return json + "\"";
}

Bytes hex_bytes(const std::string& text) {
  if (text.size() % 2 != 0 || text.find_first_not_of("0123456789abcdefABCDEF") != std::string::npos) {
    usage(text + ": expected hexadecimal digits");
  }
  Bytes bytes;
  for (size_t at = 0; at < text.size(); at += 2) {
    bytes.push_back(static_cast<uint8_t>(std::stoul(text.substr(at, 2), nullptr, 16)));
  }
  return bytes;
}

std::string hex(const uint8_t* bytes, size_t count) {
  static const char digits[] = "0123456789abcdef";
  std::string text;
  for (size_t at = 0; at < count; ++at) {
    text += digits[bytes[at] >> 4];
    text += digits[bytes[at] & 15];
  }
  return text;
}

Publisher::Publisher(const Options& options)
    : options_(options), record_(options.record_file, "seq,time_ns,call_ns,ok") {
  if (!options.payload_file.empty()) {
    std::ifstream file(options.payload_file, std::ios::binary);
    if (!file) usage("--payload-file " + options.payload_file + ": can't be read");
    file_.assign(std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>());
  }
}

bool Publisher::next() {
  const int64_t period_ns = options_.rate_hz > 0 ? static_cast<int64_t>(1e9 / options_.rate_hz) : 0;
  if (attempted_ == 0) {
    begin_ns_ = due_ns_ = monotonic_ns();
  } else if (options_.burst > 0 && attempted_ % options_.burst == 0) {
    pause();
    due_ns_ = monotonic_ns();
  } else {
    due_ns_ += period_ns;
    // A timer that skips the ticks it was too late for, as those of rclcpp do: a stalled write lowers the rate.
    const int64_t late_ns = monotonic_ns() - due_ns_;
    if (period_ns > 0 && late_ns > period_ns) {
      const int64_t skipped = late_ns / period_ns;
      skipped_ticks_ += static_cast<uint64_t>(skipped);
      due_ns_ += skipped * period_ns;
    }
  }
  const bool all_sent = options_.count > 0 && attempted_ >= options_.count;
  const bool time_up =
      options_.duration_s > 0 && due_ns_ - begin_ns_ >= static_cast<int64_t>(options_.duration_s * 1e9);
  if (!all_sent && !time_up && period_ns > 0) sleep_until(due_ns_);
  if (all_sent || time_up || stop_requested) return false;

  seq_ = options_.first_seq + attempted_;
  sent_ns_ = monotonic_ns();
  source_ns_ = realtime_ns() - static_cast<int64_t>(options_.source_age_s * 1e9);
  const size_t header = options_.encapsulation.size();
  if (options_.payload_file.empty()) {
    const size_t size = options_.sizes[seq_ % options_.sizes.size()];
    bytes_.resize(header + size);
    uint8_t* payload = bytes_.data() + header;
    uint8_t front[24];
    std::memcpy(front, &seq_, 8);
    std::memcpy(front + 8, &sent_ns_, 8);
    std::memcpy(front + 16, &source_ns_, 8);
    std::memcpy(payload, front, std::min<size_t>(size, sizeof front));
    if (options_.plain) {
      if (size >= sizeof front + 8) std::memcpy(payload + size - 8, &seq_, 8);
    } else if (size > sizeof front) {
      fill(payload + sizeof front, size - sizeof front, options_.seed, seq_);
    }
  } else {
    bytes_.resize(header + file_.size());
    std::copy(file_.begin(), file_.end(), bytes_.begin() + static_cast<std::ptrdiff_t>(header));
  }
  std::copy(options_.encapsulation.begin(), options_.encapsulation.end(), bytes_.begin());
  return true;
}

void Publisher::pause() {
  go_requested = 0;
  emit("{\"event\":\"paused\",\"attempted\":" + std::to_string(attempted_) + ",\"ok\":" + std::to_string(ok_) + "}");
  while (!go_requested && !stop_requested) sleep_until(monotonic_ns() + 10'000'000);
}

void Publisher::make_priming_sample() {
  source_ns_ = realtime_ns();
  const size_t header = options_.encapsulation.size();
  bytes_.assign(header + 24, 0);
  std::copy(options_.encapsulation.begin(), options_.encapsulation.end(), bytes_.begin());
  std::memcpy(bytes_.data() + header, &priming_seq, 8);
}

void Publisher::record(bool ok, int64_t call_ns) {
  ++attempted_;
  ++(ok ? ok_ : failed_);
  if (ok && !options_.plain) hash_ += hash_of(bytes_.data(), bytes_.size());
  calls_ns_.push_back(call_ns);
  record_.row(seq_, sent_ns_, call_ns, ok);
  end_ns_ = monotonic_ns();
  if (!options_.summary) {
    emit("{\"event\":\"write\",\"seq\":" + std::to_string(seq_) + ",\"call_us\":" + microseconds(call_ns) +
         ",\"ok\":" + (ok ? "true}" : "false}"));
  } else if (end_ns_ - progress_ns_ >= progress_period_ns) {
    progress_ns_ = end_ns_;
    emit("{\"event\":\"progress\",\"attempted\":" + std::to_string(attempted_) + ",\"ok\":" + std::to_string(ok_) +
         "}");
  }
}

void Publisher::finish_sending() {
  emit("{\"event\":\"progress\",\"attempted\":" + std::to_string(attempted_) + ",\"ok\":" + std::to_string(ok_) + "}");
}

void Publisher::print_summary() {
  // n samples span n - 1 periods.
  const double elapsed_s = static_cast<double>(end_ns_ - begin_ns_) / 1e9;
  const double rate_hz = ok_ > 1 && elapsed_s > 0 ? static_cast<double>(ok_ - 1) / elapsed_s : 0;
  emit("{\"event\":\"summary\",\"role\":\"pub\",\"attempted\":" + std::to_string(attempted_) +
       ",\"ok\":" + std::to_string(ok_) + ",\"failed\":" + std::to_string(failed_) +
       ",\"first\":" + std::to_string(options_.first_seq) + ",\"last\":" + std::to_string(seq_) +
       ",\"skipped_ticks\":" + std::to_string(skipped_ticks_) + ",\"call_us\":" + distribution(calls_ns_) +
       ",\"rate_hz\":" + std::to_string(rate_hz) + ",\"elapsed_s\":" + std::to_string(elapsed_s) +
       ",\"acknowledged\":" + (acknowledged_ ? "true" : "false") + ",\"hash\":\"" + hash_text(hash_) + "\"}");
}

uint32_t key_of(const Bytes& bytes, uint32_t keys) {
  uint64_t seq = 0;
  if (keys == 0 || bytes.size() < header_bytes + 8) return 0;
  std::memcpy(&seq, bytes.data() + header_bytes, 8);
  return static_cast<uint32_t>(seq % keys);
}

Bytes key_sample(uint32_t key) {
  Bytes bytes{0, 1, 0, 0};
  bytes.resize(header_bytes + 8, 0);
  std::memcpy(bytes.data() + header_bytes, &key, sizeof key);
  return bytes;
}

uint32_t key_of_hash(const uint8_t* hash) {
  return static_cast<uint32_t>(hash[0]) << 24 | static_cast<uint32_t>(hash[1]) << 16 |
         static_cast<uint32_t>(hash[2]) << 8 | hash[3];
}

void hash_of_key(uint32_t key, uint8_t* hash) {
  std::memset(hash, 0, 16);
  for (int at = 0; at < 4; ++at) hash[at] = static_cast<uint8_t>(key >> (24 - 8 * at));
}

Subscriber::Subscriber(const Options& options)
    : options_(options),
      record_(options.record_file, "seq,time_ns,latency_ns"),
      begin_ns_(monotonic_ns()),
      stalled_ns_(begin_ns_) {}

bool Subscriber::check(const uint8_t* payload, size_t count, uint64_t seq) {
  size_t size = count;
  if (!options_.sizes.empty()) {
    size = options_.sizes[seq % options_.sizes.size()];
    if (count < size || count - size > 3) return false;
  }
  if (options_.plain) return size < 32 || std::memcmp(payload + size - 8, &seq, 8) == 0;
  Bytes expected(count, 0);
  const size_t front = std::min<size_t>(count, 24);
  std::memcpy(expected.data(), payload, front);
  if (size > 24) fill(expected.data() + 24, size - 24, options_.seed, seq);
  size_t same = static_cast<size_t>(
      std::mismatch(expected.begin(), expected.end(), payload).first - expected.begin());
  if (size == count && same < count && count - same <= 3) {
    // The sender's size is not known: up to three zeros at the end are RTPS' padding.
    while (same < count && payload[same] == 0) ++same;
    if (same == count) ++padded_;
  } else if (same == count && size < count) {
    ++padded_;
  }
  return same == count;
}

void Subscriber::take(const uint8_t* bytes, size_t count, int64_t source_ns) {
  const int64_t now_ns = monotonic_ns();
  uint64_t seq = 0;
  if (!options_.opaque && count >= header_bytes + 8) {
    std::memcpy(&seq, bytes + header_bytes, 8);
    if (seq == priming_seq) return;
  }
  if (last_arrival_ns_ != 0) max_gap_ns_ = std::max(max_gap_ns_, now_ns - last_arrival_ns_);
  last_arrival_ns_ = now_ns;

  const size_t header = std::min(count, header_bytes);
  const std::string encapsulation = hex(bytes, header);
  ++headers_[encapsulation];
  const uint8_t* payload = bytes + header;
  const size_t size = count - header;
  size_min_ = std::min(size_min_, size);
  size_max_ = std::max(size_max_, size);
  payload_bytes_ += size;

  const bool numbered = !options_.opaque && size >= 8;
  bool good = true;
  if (numbered) {
    good = check(payload, size, seq);
    if (!good) ++bad_;
    if (seen_.insert(seq).second) {
      ++received_;
      if (!options_.plain) hash_ += hash_of(bytes, count);
      if (any_numbered_ && seq < last_) ++out_of_order_;
      last_ = any_numbered_ ? std::max(last_, seq) : seq;
      any_numbered_ = true;
    } else {
      ++duplicates_;
    }
  } else {
    ++received_;
    ++unnumbered_;
    hash_ += hash_of(bytes, count);
  }

  std::string latency = "null";
  if (numbered && size >= 16) {
    int64_t sent_ns = 0;
    std::memcpy(&sent_ns, payload + 8, 8);
    latencies_ns_.push_back(now_ns - sent_ns);
    record_.row(seq, now_ns, now_ns - sent_ns);
    latency = microseconds(now_ns - sent_ns);
  }
  if (numbered && size >= 24) {
    int64_t expected_ns = 0;
    std::memcpy(&expected_ns, payload + 16, 8);
    // An RTPS timestamp counts in 2^-32 s: converting to it and back may cost a nanosecond each time.
    const int64_t off_ns = source_ns > expected_ns ? source_ns - expected_ns : expected_ns - source_ns;
    ++(off_ns <= 10 ? source_kept_ : source_changed_);
  }
  if (!options_.summary) {
    emit("{\"event\":\"sample\",\"seq\":" + (numbered ? std::to_string(seq) : "null") +
         ",\"size\":" + std::to_string(size) + ",\"header\":\"" + encapsulation + "\",\"latency_us\":" + latency +
         ",\"source_ns\":" + std::to_string(source_ns) + ",\"good\":" + (good ? "true}" : "false}"));
  }
}

void Subscriber::state(uint32_t key, const std::string& state) {
  std::string& known = states_[key];
  if (known == state) return;
  known = state;
  emit("{\"event\":\"key\",\"key\":" + std::to_string(key) + ",\"state\":\"" + state + "\"}");
}

void Subscriber::housekeeping() {
  const int64_t now_ns = monotonic_ns();
  if (options_.summary && received_ != progress_received_ && now_ns - progress_ns_ >= progress_period_ns) {
    progress_ns_ = now_ns;
    progress_received_ = received_;
    emit("{\"event\":\"progress\",\"received\":" + std::to_string(received_) + ",\"last\":" + std::to_string(last_) +
         "}");
  }
  if (options_.stall_every_s > 0 && now_ns - stalled_ns_ >= static_cast<int64_t>(options_.stall_every_s * 1e9)) {
    sleep_until(now_ns + static_cast<int64_t>(options_.stall_for_s * 1e9));
    stalled_ns_ = monotonic_ns();
  }
}

bool Subscriber::done() const {
  const bool enough = options_.count > 0 && received_ >= options_.count;
  const bool time_up =
      options_.duration_s > 0 && monotonic_ns() - begin_ns_ >= static_cast<int64_t>(options_.duration_s * 1e9);
  return stop_requested || enough || time_up;
}

void Subscriber::print_summary() {
  std::vector<uint64_t> sequences(seen_.begin(), seen_.end());
  std::sort(sequences.begin(), sequences.end());
  std::string missing;
  uint64_t missing_count = 0;
  size_t ranges = 0;
  for (size_t at = 1; at < sequences.size(); ++at) {
    const uint64_t gap = sequences[at] - sequences[at - 1] - 1;
    if (gap == 0) continue;
    missing_count += gap;
    if (++ranges > max_missing_ranges) continue;
    if (!missing.empty()) missing += ",";
    missing += "[" + std::to_string(sequences[at - 1] + 1) + "," + std::to_string(sequences[at] - 1) + "]";
  }
  std::string headers;
  for (const auto& [header, count] : headers_) {
    if (!headers.empty()) headers += ",";
    headers += "\"" + header + "\":" + std::to_string(count);
  }
  std::string keys;
  for (const auto& [key, state] : states_) {
    if (!keys.empty()) keys += ",";
    keys += "\"" + std::to_string(key) + "\":\"" + state + "\"";
  }
  const bool any = received_ > 0;
  emit("{\"event\":\"summary\",\"role\":\"sub\",\"received\":" + std::to_string(received_) +
       ",\"unnumbered\":" + std::to_string(unnumbered_) +
       ",\"first\":" + (any_numbered_ ? std::to_string(sequences.front()) : "null") +
       ",\"last\":" + (any_numbered_ ? std::to_string(sequences.back()) : "null") + ",\"missing\":[" + missing +
       "],\"keys\":{" + keys + "},\"missing_count\":" + std::to_string(missing_count) +
       ",\"duplicates\":" + std::to_string(duplicates_) +
       ",\"out_of_order\":" + std::to_string(out_of_order_) + ",\"bad\":" + std::to_string(bad_) +
       ",\"padded\":" + std::to_string(padded_) + ",\"bytes\":" + std::to_string(payload_bytes_) +
       ",\"size_min\":" + std::to_string(any ? size_min_ : 0) + ",\"size_max\":" + std::to_string(size_max_) +
       ",\"headers\":{" + headers + "},\"source_timestamps_kept\":" + std::to_string(source_kept_) +
       ",\"source_timestamps_changed\":" + std::to_string(source_changed_) +
       ",\"latency_us\":" + distribution(latencies_ns_) +
       ",\"max_gap_ms\":" + std::to_string(static_cast<double>(max_gap_ns_) / 1e6) + ",\"hash\":\"" +
       hash_text(hash_) + "\"}");
}
