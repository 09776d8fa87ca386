//! The backlog of a route: samples that ingress keeps for a lane that restarts.
//!
//! iceoryx2 retains a fixed number of samples for new subscribers, which has to be small where a route allows
//! large ones. For a backlog, ingress is a subscriber of its own channel and holds the last samples, as many
//! as fit a number of bytes. A lane that restarts copies those that it lacks from the pool: a board tells
//! where the slots are, and the number of the first sample that is kept.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{Ordering, fence};

use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};
use iceoryx2::sample::Sample;

use super::board::{BoardWriter, Boards};
use super::channel::{ICEORYX_HEADER_BYTES, RouteChannel, SLOT_HEADER_BYTES};
use super::error::ShmError;
use super::header::WireHeader;
use super::node::{NodeShared, ShmNode, StartLock};
use super::pool_view::PoolFile;
use super::publisher::SamplePublisher;
use super::service::Service;
use super::subscriber::ShmSample;
use crate::model::Backlog;

/// The last samples of a route, which ingress keeps.
#[derive(Debug)]
pub struct BacklogKeeper {
    // In this order: samples need their port, and both the membership.
    kept: VecDeque<KeptSample>,
    port: Subscriber<Service, [u8], WireHeader>,
    _node: Arc<NodeShared>,
    bytes: u64,
    max_samples: usize,
    max_bytes: u64,
    board: BoardWriter<Backlog>,
}

#[derive(Debug)]
struct KeptSample {
    sequence: u64,
    bytes: u64,
    _slot: Sample<Service, [u8], WireHeader>,
}

impl BacklogKeeper {
    /// Keeps samples of the publisher's channel, of `max_bytes` in all; `None` for a route without a backlog.
    ///
    /// # Errors
    /// iceoryx2 refuses another subscriber, or shared memory has no room for its queue.
    pub fn open(
        node: &ShmNode,
        channel: &RouteChannel,
        publisher: &SamplePublisher,
        max_bytes: u64,
        mut board: BoardWriter<Backlog>,
    ) -> Result<Option<Self>, ShmError> {
        board.set(publisher.empty_backlog());
        let Some(queue) = channel.backlog() else { return Ok(None) };
        let shared = node.shared();
        let start = StartLock::take(shared.dir())?;
        let factory = channel.open(shared, &start)?;
        let what = format!("the backlog of route {}", channel.route);
        shared.require_free(0, &what, &start)?;
        let create = || factory.subscriber_builder().buffer_size(channel.depth(queue)).create();
        let port = match create() {
            // A dead former process counts until it is cleaned up.
            Err(SubscriberCreateError::ExceedsMaxSupportedSubscribers) => {
                shared.clean_up(&start);
                create()
            }
            other => other,
        };
        let port =
            port.map_err(|error| ShmError::failed(format!("to create {what}"), shared.folder(), error))?;
        shared.commit(&what)?;
        Ok(Some(Self {
            // No sample of a steady flow allocates.
            kept: VecDeque::with_capacity(channel.backlog_samples + 1),
            port,
            _node: shared.clone(),
            bytes: 0,
            max_samples: channel.backlog_samples,
            max_bytes,
            board,
        }))
    }

    /// Keeps the samples that were published since the last call, and frees the oldest that are too many.
    pub fn keep_published(&mut self) {
        while let Ok(Some(slot)) = self.port.receive() {
            let WireHeader { sample, payload_bytes } = *slot.user_header();
            let sequence = sample.sequence;
            // With a hole, the number of the first one would not tell which samples are kept.
            if self.kept.back().is_some_and(|last| last.sequence + 1 != sequence) {
                self.free_all();
            }
            self.bytes += payload_bytes;
            self.kept.push_back(KeptSample { sequence, bytes: payload_bytes, _slot: slot });
        }
        let mut too_many = 0;
        while self.bytes > self.max_bytes || self.kept.len() - too_many > self.max_samples {
            self.bytes -= self.kept[too_many].bytes;
            too_many += 1;
        }
        self.show_first(too_many);
        self.kept.drain(..too_many);
    }

    /// Frees all samples, because a new one needs their memory. Returns whether there were any.
    pub fn free_all(&mut self) -> bool {
        self.show_first(self.kept.len());
        self.bytes = 0;
        let had_any = !self.kept.is_empty();
        self.kept.clear();
        had_any
    }

    /// Shows on the board that the sample at this place is the first one. To be called before those before it
    /// are freed.
    fn show_first(&mut self, place: usize) {
        let first_sequence = self.kept.get(place).map_or(0, |first| first.sequence);
        if self.board.get().first_sequence != first_sequence {
            self.board.update(|backlog| backlog.first_sequence = first_sequence);
            // A reader that finds the bytes of a later sample in a freed slot sees the change as well.
            fence(Ordering::Release);
        }
    }
}

/// Copies the samples of a route with these sequence numbers that ingress keeps, in order. All of `wanted`
/// must be numbers of published samples, at most that of one which the caller, or the process that it
/// continues, has received: the header of a later sample may have its number already, and not the rest.
///
/// # Errors
/// The pool cannot be opened, for example because ingress has ended.
pub fn read_backlog(boards: &Boards, route: usize, wanted: Range<u64>) -> Result<Vec<ShmSample>, ShmError> {
    let kept = |wanted: &Range<u64>, backlog: &Backlog| {
        let first = backlog.first_sequence;
        if first == 0 { 0..0 } else { wanted.start.max(first)..wanted.end }
    };
    let Some(backlog) = boards.backlog(route) else { return Ok(Vec::new()) };
    let range = kept(&wanted, &backlog);
    if range.is_empty() {
        return Ok(Vec::new());
    }
    let pool = PoolFile::open(backlog.pool.as_str())?;
    let mut samples = Vec::new();
    for slot in 0..backlog.slots {
        let begin = backlog.first_offset + slot * backlog.stride_bytes;
        let Some(header) = pool.header(begin + ICEORYX_HEADER_BYTES as u64) else { break };
        let fits = header.payload_bytes <= backlog.stride_bytes - SLOT_HEADER_BYTES as u64;
        if fits && range.contains(&header.sample.sequence) {
            samples.push((header, begin + SLOT_HEADER_BYTES as u64));
        }
    }
    samples.sort_unstable_by_key(|(header, _)| header.sample.sequence);
    let copy = |(header, payload): (WireHeader, u64)| {
        Some(ShmSample::copied(header.sample, pool.payload(payload, header.payload_bytes)?))
    };
    let mut samples: Vec<ShmSample> = samples.into_iter().filter_map(copy).collect();
    // The slots of samples that are not kept any more may have been written meanwhile.
    fence(Ordering::Acquire);
    let after = boards.backlog(route).filter(|after| after.pool == backlog.pool).unwrap_or_default();
    let range = kept(&wanted, &after);
    samples.retain(|sample| range.contains(&sample.header().sequence));
    Ok(samples)
}
