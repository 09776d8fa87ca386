//! The service variant of iceoryx2 that the bridge uses: thread-safe and inter-process, but loaning a sample
//! does not allocate.
//!
//! iceoryx2 0.10 keeps the state of each loaned sample in an `Arc` with a mutex, and so allocates for each
//! sample. This variant keeps the memory of such an `Arc` and reuses it for the next sample.

use std::alloc::{Layout, alloc, dealloc, handle_alloc_error};
use std::fmt::Debug;
use std::ops::Deref;
use std::ptr::NonNull;
use std::sync::atomic::{AtomicUsize, Ordering, fence};
use std::sync::{Mutex as StdMutex, PoisonError};

use iceoryx2::prelude::ZeroCopySend;
use iceoryx2::service::internal::ServiceInternal;
use iceoryx2::unique_id_generator::unique_system_id::UniqueSystemId;
use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_bb_posix::mutex::{Handle, Mutex, MutexBuilder, MutexGuard, MutexHandle, MutexType};
use iceoryx2_cal::arc_sync_policy::{ArcSyncPolicy, ArcSyncPolicyCreationError, LockGuard};
use iceoryx2_cal::shm_allocator::{bump_allocator::BumpAllocator, pool_allocator::PoolAllocator};
use iceoryx2_cal::*;

/// Like `iceoryx2::service::ipc_threadsafe::Service`, but reuses the memory of loans.
#[derive(Clone, Debug)]
pub(super) struct Service;

impl iceoryx2::service::Service for Service {
    type StaticStorage = static_storage::recommended::Ipc;
    type ConfigSerializer = serialize::recommended::Recommended;
    type PersistentDynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> =
        dynamic_storage::recommended::PersistentIpc<T>;
    type Bag = bag::recommended::Recommended;
    type DynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> =
        dynamic_storage::recommended::Ipc<T>;
    type ServiceNameHasher = hash::recommended::Recommended;
    type SharedMemory = shared_memory::recommended::Ipc<PoolAllocator>;
    type ResizableSharedMemory = resizable_shared_memory::recommended::Ipc<PoolAllocator>;
    type Connection = zero_copy_connection::recommended::Ipc;
    type Event = event::recommended::Ipc;
    type Monitoring = monitoring::recommended::Ipc;
    type Reactor = reactor::recommended::Ipc;
    type ArcThreadSafetyPolicy<T: Send + Debug + Abandonable> = RecycledArc<T>;
    type BlackboardMgmt<T: Send + Sync + Debug + ZeroCopySend + 'static> =
        dynamic_storage::recommended::Ipc<T>;
    type BlackboardPayload = shared_memory::recommended::Ipc<BumpAllocator>;
    type UniqueId = UniqueSystemId;
}

impl ServiceInternal<Service> for Service {}

/// The layout of the memory blocks that are kept. The state of a loan fits into one.
const BLOCK: Layout = match Layout::from_size_align(256, 16) {
    Ok(layout) => layout,
    Err(_) => panic!("256 and 16 are a valid layout"),
};
/// The most blocks that are kept. Ingress holds at most 3 loans of a route at the same time.
const KEPT_BLOCKS: usize = 64;

/// Unused blocks with layout [`BLOCK`].
struct Blocks(Vec<NonNull<u8>>);

// SAFETY: the pointers are the only ones to unused memory.
unsafe impl Send for Blocks {}

static BLOCKS: StdMutex<Blocks> = StdMutex::new(Blocks(Vec::new()));

fn fits_block(layout: Layout) -> bool {
    layout.size() <= BLOCK.size() && layout.align() <= BLOCK.align()
}

/// Returns memory for `layout`: a kept block if it fits, else newly allocated memory.
fn take_memory(layout: Layout) -> NonNull<u8> {
    let layout = if fits_block(layout) {
        #[allow(clippy::disallowed_methods, reason = "held for the push or pop of one pointer")]
        let mut blocks = BLOCKS.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(block) = blocks.0.pop() {
            return block;
        }
        // Reserved here, because a block may be returned on a hot path, which must not allocate.
        if blocks.0.capacity() == 0 {
            blocks.0.reserve_exact(KEPT_BLOCKS);
        }
        BLOCK
    } else {
        layout
    };
    // SAFETY: neither layout has size 0: `Shared` holds a counter.
    NonNull::new(unsafe { alloc(layout) }).unwrap_or_else(|| handle_alloc_error(layout))
}

/// Keeps the memory as a block, or frees it.
///
/// # Safety
/// `memory` comes from `take_memory` with the same layout, and is not used any more.
unsafe fn return_memory(memory: NonNull<u8>, layout: Layout) {
    let layout = if fits_block(layout) {
        #[allow(clippy::disallowed_methods, reason = "held for the push or pop of one pointer")]
        let mut blocks = BLOCKS.lock().unwrap_or_else(PoisonError::into_inner);
        if blocks.0.len() < KEPT_BLOCKS {
            blocks.0.push(memory);
            return;
        }
        BLOCK
    } else {
        layout
    };
    // SAFETY: `take_memory` allocated it with this layout.
    unsafe { dealloc(memory.as_ptr(), layout) };
}

/// The memory that all handles of a [`RecycledArc`] share.
struct Shared<T: Debug> {
    handles: AtomicUsize,
    /// A recursive mutex, as in iceoryx2's own variant.
    mutex: MutexHandle<T>,
}

/// A value behind a mutex that threads share, like `Arc<Mutex<T>>`, in reused memory.
#[derive(Debug)]
pub(super) struct RecycledArc<T: Send + Debug + Abandonable> {
    shared: NonNull<Shared<T>>,
}

// SAFETY: as for `Arc<Mutex<T>>`: the count is atomic, and the value is accessed under the mutex only.
unsafe impl<T: Send + Debug + Abandonable> Send for RecycledArc<T> {}
// SAFETY: as above.
unsafe impl<T: Send + Debug + Abandonable> Sync for RecycledArc<T> {}

impl<T: Send + Debug + Abandonable> RecycledArc<T> {
    fn shared(&self) -> &Shared<T> {
        // SAFETY: initialised by `new`, and valid until the last handle is dropped; this handle is not
        // dropped yet. Only shared references to it are created.
        unsafe { self.shared.as_ref() }
    }

    fn mutex(&self) -> Mutex<'_, '_, T> {
        // SAFETY: `new` initialised the handle, and it does not move while there are handles.
        unsafe { Mutex::from_handle(&self.shared().mutex) }
    }
}

impl<T: Send + Debug + Abandonable> Clone for RecycledArc<T> {
    fn clone(&self) -> Self {
        self.shared().handles.fetch_add(1, Ordering::Relaxed);
        Self { shared: self.shared }
    }
}

impl<T: Send + Debug + Abandonable> Drop for RecycledArc<T> {
    fn drop(&mut self) {
        if self.shared().handles.fetch_sub(1, Ordering::Release) != 1 {
            return;
        }
        // Accesses of other threads before they dropped their handles happen before the value is dropped.
        fence(Ordering::Acquire);
        // SAFETY: this was the last handle, so there is no other reference; `new` initialised the value and
        // the mutex in place.
        unsafe { self.shared.drop_in_place() };
        // SAFETY: the memory comes from `take_memory` with this layout, and is not used any more.
        unsafe { return_memory(self.shared.cast(), Layout::new::<Shared<T>>()) };
    }
}

impl<T: Send + Debug + Abandonable> Abandonable for RecycledArc<T> {
    /// Like iceoryx2's own variant: the last handle abandons the value and leaks the memory, any other handle
    /// is dropped. Only iceoryx2's tests call this.
    unsafe fn abandon_in_place(mut this: NonNull<Self>) {
        // SAFETY: the caller passes a valid handle, and does not use or drop it afterwards.
        let handle = unsafe { this.as_mut() };
        if handle.shared().handles.load(Ordering::Acquire) == 1 {
            #[allow(clippy::disallowed_methods, reason = "there is no other handle")]
            let locked = handle.mutex().lock();
            if let Ok(mut value) = locked {
                // SAFETY: there is no other handle, and the value is not used afterwards.
                unsafe { T::abandon_in_place(NonNull::from(&mut *value)) };
            }
        } else {
            // SAFETY: not used afterwards, as the caller guarantees.
            unsafe { this.drop_in_place() };
        }
    }
}

/// The lock guard of a [`RecycledArc`], which gives access to the value.
pub(super) struct Guard<'parent, T: Send + Debug>(MutexGuard<'parent, T>);

impl<T: Send + Debug> Deref for Guard<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0
    }
}

impl<'parent, T: Send + Debug + Abandonable> LockGuard<'parent, T> for Guard<'parent, T> {}

impl<T: Send + Debug + Abandonable> ArcSyncPolicy<T> for RecycledArc<T> {
    type LockGuard<'parent>
        = Guard<'parent, T>
    where
        Self: 'parent,
        T: 'parent;

    fn new(value: T) -> Result<Self, ArcSyncPolicyCreationError> {
        let shared = take_memory(Layout::new::<Shared<T>>()).cast::<Shared<T>>();
        // SAFETY: fresh memory of that layout.
        unsafe { shared.write(Shared { handles: AtomicUsize::new(1), mutex: MutexHandle::new() }) };
        let arc = Self { shared };
        match MutexBuilder::new()
            .is_interprocess_capable(false)
            .mutex_type(MutexType::Recursive)
            .create(value, &arc.shared().mutex)
        {
            Ok(_) => Ok(arc),
            Err(_) => Err(ArcSyncPolicyCreationError::InsufficientResources),
        }
    }

    fn lock(&self) -> Guard<'_, T> {
        #[allow(clippy::disallowed_methods, reason = "threads use a publisher in turns (ingress/pool.rs)")]
        let locked = self.mutex().lock();
        match locked {
            Ok(guard) => Guard(guard),
            // Locking a recursive mutex of this process fails only when one thread has locked it 2^32 times
            // or when its memory is corrupted; neither can be recovered from.
            Err(error) => panic!("cannot lock a mutex of this process: {error:?}"),
        }
    }
}
