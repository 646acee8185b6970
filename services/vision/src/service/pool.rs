//! Several services as one: calls go where a slot is free, the urgent ones first, and to another service when one fails.

use super::member::{Client, Described, Member, plain};
use super::queue::{CallQueue, Priority, Ticket};
use super::wire::MessageError;
use crate::service_error::ServiceError;
use crate::service_tls::innermost;
use segwild_proto::v1::Capability;
use std::error::Error;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::OwnedSemaphorePermit;
use tonic::{Code, Status};

/// A call that a service answers with an error of its own, or not in time, is tried so often in all.
const ATTEMPTS: u32 = 3;
/// Calls per service that should wait here for a slot: a slot that becomes free then goes to the most urgent call, and not to a
/// bulk one because the next urgent one is not there yet.
const WAITING: usize = 1;
/// Longest time until the services are checked again for one that may be called.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// How long services are waited for.
#[derive(Clone, Copy, Debug)]
pub struct ServiceTerms {
    /// For an answer.
    pub deadline: Duration,
    /// For one of them to come back, when none answers any more.
    pub patience: Duration,
    /// For the first one to answer.
    pub first_patience: Duration,
}

/// Services with the same models.
pub(super) struct ServicePool {
    pub members: Vec<Arc<Member>>,
    pub described: Described,
    pub terms: ServiceTerms,
    pub queue: CallQueue,
}

/// A slot of a service, while a call is there.
struct Slot<'a> {
    permit: Option<OwnedSemaphorePermit>,
    queue: &'a CallQueue,
}

impl Drop for Slot<'_> {
    fn drop(&mut self) {
        drop(self.permit.take());
        self.queue.check_again();
    }
}

/// Why a call has no answer.
#[derive(Debug)]
pub(super) enum CallError {
    /// The service's status.
    Status(Status),
    /// Its answer is not what it should be.
    Message(MessageError),
    /// It has other models than before.
    Changed,
    /// It has another model of texts than the call needs, or none.
    OtherTexts,
}

impl From<Status> for CallError {
    fn from(status: Status) -> CallError {
        CallError::Status(status)
    }
}

impl From<MessageError> for CallError {
    fn from(error: MessageError) -> CallError {
        CallError::Message(error)
    }
}

/// What a status means for the next attempt.
enum Verdict {
    /// Nobody is there: another service, or the same one later.
    Gone,
    /// It has too much to do.
    Busy,
    /// It failed at this call: another attempt may do.
    Failed,
    /// It refuses this call, and would again.
    Refused,
    /// It lets nobody in with this token.
    Unknown,
}

fn verdict(status: &Status) -> Verdict {
    match status.code() {
        Code::Unauthenticated | Code::PermissionDenied => Verdict::Unknown,
        Code::Unavailable => Verdict::Gone,
        // The transport failed, not the service.
        _ if status.source().is_some() => Verdict::Gone,
        Code::Cancelled => Verdict::Gone,
        Code::ResourceExhausted => Verdict::Busy,
        Code::InvalidArgument | Code::OutOfRange | Code::Unimplemented | Code::FailedPrecondition => {
            Verdict::Refused
        }
        _ => Verdict::Failed,
    }
}

fn words(status: &Status) -> String {
    let source = status.source().map_or(String::new(), |source| format!(" ({})", innermost(source)));
    plain(&format!("{}{source}", status.message()))
}

impl ServicePool {
    /// Asks all services what they are. Those that do not answer yet rest.
    ///
    /// # Errors
    /// When none answers in time, one refuses the token, or two have different models.
    pub async fn connect(
        members: Vec<Arc<Member>>,
        terms: ServiceTerms,
    ) -> Result<Arc<ServicePool>, ServiceError> {
        let began = Instant::now();
        loop {
            let answers =
                futures_util::future::join_all(members.iter().map(|member| member.describe())).await;
            let mut first: Option<(&Arc<Member>, Described)> = None;
            let mut texts: Option<String> = None;
            for (member, answer) in members.iter().zip(answers) {
                match answer {
                    Err(status) if matches!(verdict(&status), Verdict::Unknown | Verdict::Refused) => {
                        return Err(refusal(member, &status));
                    }
                    Err(status) => _ = member.fails(&words(&status)),
                    Ok(described) => {
                        member.answers();
                        // Not each has a model of texts: the first one's key counts.
                        texts = texts.or_else(|| described.texts().cloned());
                        match &first {
                            Some((other, known)) if !known.serves_as(&described) => {
                                return Err(ServiceError::Differ {
                                    one: other.address.clone(),
                                    other: member.address.clone(),
                                });
                            }
                            Some(_) => {}
                            None => first = Some((member, described)),
                        }
                    }
                }
            }
            if let Some((_, mut described)) = first {
                described.keys.extend(texts.map(|key| (Capability::EmbedText, key)));
                let pool = Arc::new(ServicePool { described, terms, queue: CallQueue::default(), members });
                let unknown = pool.members.iter().filter(|member| member.is_unknown());
                unknown.for_each(|member| pool.wait_for(member));
                return Ok(pool);
            }
            if began.elapsed() > terms.first_patience {
                return Err(gone(&members, terms.first_patience));
            }
            tokio::time::sleep(POLL_INTERVAL).await;
        }
    }

    /// Calls that are worth making at a time: those that all services together are sent, and a few that wait for a slot.
    pub fn calls(&self) -> usize {
        let sent = self.members.iter().map(|member| member.calls());
        sent.filter(|calls| *calls > 0).map(|calls| calls + WAITING).sum()
    }

    /// A service with a free slot, the one with most of them first; waits until it is the call's turn. `None` when no service may
    /// be called now.
    async fn slot(&self, ticket: Ticket, texts: Option<&str>) -> Option<(&Arc<Member>, Slot<'_>)> {
        self.queue.turn(ticket, POLL_INTERVAL, || self.free_slot(texts)).await
    }

    fn free_slot(&self, texts: Option<&str>) -> ControlFlow<Option<(&Arc<Member>, Slot<'_>)>> {
        let now = Instant::now();
        let members = self.members.iter().filter(|member| member.has(texts));
        let mut with_slots: Vec<_> =
            members.filter_map(|member| Some((member, member.slots(now)?))).collect();
        if with_slots.is_empty() {
            return ControlFlow::Break(None);
        }
        with_slots.sort_by_key(|(_, slots)| std::cmp::Reverse(slots.available_permits()));
        for (member, slots) in with_slots {
            if let Ok(permit) = slots.try_acquire_owned() {
                let slot = Slot { permit: Some(permit), queue: &self.queue };
                return ControlFlow::Break(Some((member, slot)));
            }
        }
        ControlFlow::Continue(())
    }

    /// Calls a service; another one, or the same one later, where it fails. An answer depends on the call alone, so that a call
    /// may be repeated. `texts`: key of the model of texts that the call needs, if it needs one.
    pub async fn call<T, F>(
        self: Arc<ServicePool>,
        priority: Priority,
        texts: Option<String>,
        operation: impl Fn(Client) -> F,
    ) -> Result<T, ServiceError>
    where
        F: Future<Output = Result<T, CallError>>,
    {
        let ticket = self.queue.ticket(priority, Instant::now());
        let (mut attempts, mut since) = (0, None::<Instant>);
        loop {
            let Some((member, _slot)) = self.slot(ticket, texts.as_deref()).await else {
                let since = *since.get_or_insert_with(Instant::now);
                // Those without its model are left out as far as this call goes.
                let left_out = |member: &Arc<Member>| member.is_left_out() || !member.has(texts.as_deref());
                if since.elapsed() > self.terms.patience || self.members.iter().all(left_out) {
                    return Err(gone(&self.members, self.terms.patience));
                }
                tokio::time::sleep(POLL_INTERVAL).await;
                continue;
            };
            let answer = tokio::time::timeout(self.terms.deadline, operation(member.client())).await;
            let seconds = self.terms.deadline.as_secs();
            let answer = answer.unwrap_or_else(|_| {
                Err(Status::deadline_exceeded(format!("no answer within {seconds} seconds")).into())
            });
            let status = match answer {
                Ok(answer) => {
                    member.answers();
                    return Ok(answer);
                }
                Err(CallError::Message(error)) => {
                    return Err(ServiceError::Answer {
                        address: member.address.clone(),
                        reason: error.to_string(),
                    });
                }
                Err(CallError::Changed) => {
                    leave_out(member);
                    continue;
                }
                Err(CallError::OtherTexts) => {
                    member.has_other_texts();
                    continue;
                }
                Err(CallError::Status(status)) => status,
            };
            match verdict(&status) {
                Verdict::Gone => {
                    since.get_or_insert_with(Instant::now);
                    if member.fails(&words(&status)) {
                        tracing::warn!("{} is left out until it answers: {}", member.address, words(&status));
                    }
                    self.wait_for(member);
                }
                Verdict::Busy => {
                    since.get_or_insert_with(Instant::now);
                    member.is_busy();
                }
                Verdict::Unknown => member.leave_out(words(&status)),
                Verdict::Refused => return Err(refusal(member, &status)),
                Verdict::Failed => {
                    attempts += 1;
                    if attempts >= ATTEMPTS {
                        return Err(refusal(member, &status));
                    }
                    if status.code() == Code::DeadlineExceeded {
                        member.fails(&words(&status));
                        self.wait_for(member);
                    }
                }
            }
        }
    }

    /// Asks a service that failed what it is, after each of its rests, until it answers. No call waits for one that may be gone.
    fn wait_for(self: &Arc<ServicePool>, member: &Arc<Member>) {
        if !member.starts_waiting() {
            return;
        }
        let (pool, member) = (Arc::downgrade(self), member.clone());
        tokio::spawn(async move {
            while let Some(rest) = member.rest() {
                tokio::time::sleep(rest).await;
                let answer = member.describe().await;
                let Some(pool) = pool.upgrade() else { return };
                match answer {
                    Ok(described) if described.serves_as(&pool.described) => {
                        if member.answers() {
                            tracing::warn!("{} answers again", member.address);
                        }
                    }
                    Ok(_) => leave_out(&member),
                    Err(status) => _ = member.fails(&words(&status)),
                }
                pool.queue.check_again();
            }
        });
    }
}

/// Leaves out a service that has become another one.
fn leave_out(member: &Member) {
    let reason = "it has other models than before";
    tracing::warn!("{} is not used any more: {reason}", member.address);
    member.leave_out(reason.into());
}

fn refusal(member: &Member, status: &Status) -> ServiceError {
    ServiceError::Refused { address: member.address.clone(), reason: words(status) }
}

fn gone(members: &[Arc<Member>], waited: Duration) -> ServiceError {
    let reasons: Vec<String> = members.iter().map(|member| member.reason()).collect();
    ServiceError::Gone {
        seconds: waited.as_secs(),
        reasons: reasons.join("; "),
        kind: std::io::ErrorKind::NotConnected.into(),
    }
}
