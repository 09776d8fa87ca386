// Serialized samples of any type on Cyclone DDS 0.10. Only cyclone_peer.cpp includes it.
#pragma once

#include <dds/dds.h>
#include <dds/ddsi/ddsi_serdata.h>
#include <dds/ddsi/ddsi_sertype.h>
#include <dds/ddsi/q_radmin.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>

#include "common.hpp"

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
// It has keys if `raw_keys` is not 0, and carries no XTypes information, so that only its name has to match.
struct RawSample : ddsi_serdata {
  Bytes bytes;   // with up to three zeros after `count`: Cyclone sends whole words
  uint32_t count = 0;
  uint32_t key = 0;

  RawSample(const ddsi_sertype* type, ddsi_serdata_kind kind, size_t count_) : bytes((count_ + 3) / 4 * 4, 0) {
    count = static_cast<uint32_t>(count_);
    ddsi_serdata_init(this, type, kind);
    hash = type->serdata_basehash;
  }

  RawSample* with_key(uint32_t key_) {
    key = key_;
    hash ^= key * 0x9e3779b1u;
    return this;
  }

  // The key of what was received: that of data by its sequence; a serialized key has 4 bytes, or 16 of Fast DDS,
  // which sends the key hash.
  RawSample* with_own_key();
};

// The keys of the type of all raw topics; 0 for none.
uint32_t raw_keys = 0;

RawSample* RawSample::with_own_key() {
  if (raw_keys == 0) return this;
  if (kind == SDK_DATA) return with_key(key_of(bytes, raw_keys));
  if (count >= 20) return with_key(key_of_hash(bytes.data() + 4));
  uint32_t own = 0;
  if (count >= 8) std::memcpy(&own, bytes.data() + 4, sizeof own);
  return with_key(own);
}

RawSample* raw(ddsi_serdata* sample) { return static_cast<RawSample*>(sample); }
const RawSample* raw(const ddsi_serdata* sample) { return static_cast<const RawSample*>(sample); }

bool same_key(const ddsi_serdata* one, const ddsi_serdata* other) { return raw(one)->key == raw(other)->key; }

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
  return sample->with_own_key();
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
  return sample->with_own_key();
}

// A serialized key is a number of 4 bytes in little-endian CDR.
RawSample* key_alone(const ddsi_sertype* type, uint32_t key) {
  if (raw_keys == 0) return new RawSample(type, SDK_KEY, 0);
  auto* sample = new RawSample(type, SDK_KEY, 8);
  sample->bytes[1] = 1;
  std::memcpy(sample->bytes.data() + 4, &key, sizeof key);
  return sample->with_key(key);
}

ddsi_serdata* from_keyhash(const ddsi_sertype* type, const ddsi_keyhash* hash) {
  return key_alone(type, key_of_hash(reinterpret_cast<const uint8_t*>(hash->value)));
}

ddsi_serdata* from_sample(const ddsi_sertype* type, ddsi_serdata_kind kind, const void* data) {
  const auto& bytes = *static_cast<const Bytes*>(data);
  if (kind != SDK_DATA) return key_alone(type, key_of(bytes, raw_keys));
  auto* sample = new RawSample(type, kind, bytes.size());
  if (!bytes.empty()) std::memcpy(sample->bytes.data(), bytes.data(), bytes.size());
  return sample->with_own_key();
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

ddsi_serdata* to_untyped(const ddsi_serdata* sample) { return key_alone(sample->type, raw(sample)->key); }

bool untyped_to_sample(const ddsi_sertype*, const ddsi_serdata*, void*, void**, void*) { return true; }

void free_sample(ddsi_serdata* sample) { delete raw(sample); }

size_t print_sample(const ddsi_sertype*, const ddsi_serdata*, char* buffer, size_t size) {
  if (size > 0) buffer[0] = '\0';
  return 0;
}

void keyhash_of(const ddsi_serdata* sample, ddsi_keyhash* keyhash, bool) {
  hash_of_key(raw(sample)->key, reinterpret_cast<uint8_t*>(keyhash->value));
}

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
  ddsi_sertype_init(type, name.c_str(), &type_ops, &sample_ops, raw_keys == 0);
  type->allowed_data_representation = DDS_DATA_REPRESENTATION_FLAG_XCDR1;
  return type;
}

dds_entity_t raw_topic(dds_entity_t participant, const std::string& topic, const std::string& type_name) {
  ddsi_sertype* type = raw_type(type_name);
  return check("topic", dds_create_topic_sertype(participant, topic.c_str(), &type, nullptr, nullptr, nullptr));
}

// Takes what a raw reader has: `take(bytes, count, source_ns)` for each sample with data, then
// `state(key, instance_state)` for each.
template <typename Take, typename State>
void drain(dds_entity_t reader, Take take, State state) {
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
      state(raw(samples[at])->key, infos[at].instance_state);
      ddsi_serdata_unref(samples[at]);
    }
    if (taken < static_cast<dds_return_t>(batch)) return;
  }
}

template <typename Take>
void drain(dds_entity_t reader, Take take) {
  drain(reader, take, [](uint32_t, dds_instance_state_t) {});
}

}  // namespace
