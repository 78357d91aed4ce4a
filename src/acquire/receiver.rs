//! A DICOM storage service (C-STORE and C-ECHO as provider, PS3.4 annexes A and B): what consoles send becomes files of the watched folder.
//!
//! ```text
//! association ─ commands ─ spool ─ watched folder ─ helper ─ frames
//! ```
//! A sender hears of success when its object lies in the folder, whole. What is not taken is told to it and to the session.

use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use dicom_dictionary_std::uids;
use dicom_ul::association::server::{AccessControl, ServerAssociation, ServerAssociationOptions};
use dicom_ul::pdu::{
    AbortRQSource, AssociationRJ, AssociationRJResult, AssociationRJServiceProviderPresentationReason,
    AssociationRJServiceUserReason, AssociationRJSource, PDataValue, PDataValueType, Pdu, PresentationContextNegotiated,
    PresentationContextResultReason, UserIdentity, write_pdu,
};

use super::dimse::{Outcome, Request};
use super::services::{STORAGE_CLASSES, transfer_syntaxes};
use super::source::{Sighting, Trouble};
use super::spool::{Incoming, Spool, SpoolError, Taken};

/// Associations at one time.
pub const MOST_ASSOCIATIONS: usize = 8;
/// Who says nothing for so long has gone.
const SILENCE: Duration = Duration::from_secs(60);
/// One that is turned away has so long to say why it came.
const TURNED_AWAY: Duration = Duration::from_millis(500);
/// How often somebody at the door is looked for.
const LOOK: Duration = Duration::from_millis(20);
/// Largest piece that a sender may send at once.
const PDU_BYTES: u32 = 1 << 17;
/// A command is a few identifiers and numbers.
const MOST_COMMAND_BYTES: usize = 1 << 14;

/// How to listen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReceiverOptions {
    /// Where.
    pub address: SocketAddr,
    /// The name that senders must call.
    pub ae_title: String,
    /// Names of those who may send; anybody where there are none.
    pub calling_ae_titles: Vec<String>,
}

/// Why nothing can be received.
#[derive(Debug, thiserror::Error)]
pub enum ReceiverError {
    /// The port is not to be had.
    #[error(
        "DICOM cannot be received on {address}: {source}; choose another \"port\" under \"frames.dicom\", or end the program that has it"
    )]
    Bind {
        /// Where.
        address: SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
    /// The system gives no thread.
    #[error("cannot start a thread: {source}; too many processes run, or memory is short")]
    Thread {
        /// What the system said.
        source: std::io::Error,
    },
}

/// Listens until it is closed or dropped.
pub(super) struct Receiver {
    shared: Arc<Shared>,
    address: SocketAddr,
    door: Option<std::thread::JoinHandle<()>>,
}

struct Shared {
    options: ReceiverOptions,
    spool: Spool,
    told: Mutex<Sender<Sighting>>,
    closing: AtomicBool,
    /// Connections by number, so that they can be ended.
    open: Mutex<Vec<(u64, TcpStream)>>,
}

impl Receiver {
    /// Listens; objects are written into `spool`, and `told` hears of what is not taken.
    pub(super) fn open(options: ReceiverOptions, spool: Spool, told: Sender<Sighting>) -> Result<Self, ReceiverError> {
        let refused = |source| ReceiverError::Bind { address: options.address, source };
        let listener = TcpListener::bind(options.address).map_err(refused)?;
        listener.set_nonblocking(true).map_err(refused)?;
        let address = listener.local_addr().map_err(refused)?;
        let (closing, open) = (AtomicBool::new(false), Mutex::default());
        let shared = Arc::new(Shared { options, spool, told: Mutex::new(told), closing, open });
        let at_door = Arc::clone(&shared);
        let door = std::thread::Builder::new().name("dicom".to_owned()).spawn(move || at_door.welcome(&listener));
        let door = door.map_err(|source| ReceiverError::Thread { source })?;
        Ok(Self { shared, address, door: Some(door) })
    }

    pub(super) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Ends all connections; what is half is not taken.
    pub(super) fn close(&mut self) {
        self.shared.closing.store(true, Ordering::Relaxed);
        if let Some(door) = self.door.take() {
            // One that died left nothing open that is not ended here.
            let _ = door.join();
        }
        self.shared.connections().iter().for_each(|(_, stream)| drop(stream.shutdown(Shutdown::Both)));
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        self.close();
    }
}

impl Shared {
    fn connections(&self) -> MutexGuard<'_, Vec<(u64, TcpStream)>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn tell(&self, sighting: Sighting) {
        // A folder that is no longer watched does not need to know.
        let _ = self.told.lock().unwrap_or_else(PoisonError::into_inner).send(sighting);
    }

    fn say(&self, kind: &'static str, words: String) {
        self.tell(Sighting::Said { kind, words });
    }

    fn welcome(self: Arc<Self>, listener: &TcpListener) {
        let mut number = 0;
        while !self.closing.load(Ordering::Relaxed) {
            let Ok((stream, _)) = listener.accept() else {
                std::thread::sleep(LOOK);
                continue;
            };
            number += 1;
            // Where the listener does not block, what it accepts may not either.
            let kept = stream.set_nonblocking(false).and_then(|()| stream.try_clone());
            let Ok(kept) = kept else { continue };
            if self.connections().len() >= MOST_ASSOCIATIONS {
                self.turn_away(stream);
                continue;
            }
            self.connections().push((number, kept));
            let shared = Arc::clone(&self);
            let served = std::thread::Builder::new().name("dicom association".to_owned()).spawn(move || {
                // What a sender makes of the protocol must not end more than its own connection.
                if catch_unwind(AssertUnwindSafe(|| shared.serve(stream, number))).is_err() {
                    shared.say("DICOM fault", format!("DICOM association {number} ended by a fault of this program"));
                }
                shared.connections().retain(|(known, _)| *known != number);
            });
            if let Err(error) = served {
                self.connections().retain(|(known, _)| *known != number);
                self.say("DICOM association refused", format!("DICOM association {number} is refused: {error}"));
            }
        }
    }

    /// Says that there is no room now, as the protocol has it (PS3.8 §9.3.4).
    fn turn_away(&self, mut stream: TcpStream) {
        self.say(
            "DICOM association refused",
            format!("a DICOM association is refused: {MOST_ASSOCIATIONS} are open already; its sender may try again"),
        );
        let reason = AssociationRJServiceProviderPresentationReason::LocalLimitExceeded;
        let source = AssociationRJSource::ServiceProviderPresentation(reason);
        let refusal = Pdu::AssociationRJ(AssociationRJ { result: AssociationRJResult::Transient, source });
        let mut bytes = Vec::new();
        if stream.set_read_timeout(Some(TURNED_AWAY)).is_ok() && write_pdu(&mut bytes, &refusal).is_ok() {
            // Its request is taken from the socket first: a connection that is closed over unread bytes is reset.
            let _ = std::io::Read::read(&mut stream, &mut [0; 1 << 14]);
            let _ = std::io::Write::write_all(&mut stream, &bytes);
        }
    }

    /// That a sender's offers cannot be taken: it gives up, and nobody would hear why. Many offer all there is for the case that they need it.
    fn say_unread(&self, offered: &[PresentationContextNegotiated], number: u64) {
        let is_taken = |class: &str| offered.iter().any(|offer| offer.abstract_syntax == class && is_agreed(offer));
        let is_offered = |class: &&&str| offered.iter().any(|offer| offer.abstract_syntax == **class);
        let unread: Vec<&str> = STORAGE_CLASSES.iter().filter(is_offered).filter(|class| !is_taken(class)).copied().collect();
        let words = if !unread.is_empty() {
            format!(
                "objects of class {} only in transfer syntaxes that are not read here; let it send Explicit or Implicit VR Little Endian",
                unread.join(", ")
            )
        } else if offered.iter().any(is_agreed) || offered.is_empty() {
            return;
        } else {
            "only objects that are none of the images taken here (XA, RF, DX, CR, secondary capture)".to_owned()
        };
        self.say("DICOM object not agreed on", format!("a sender offers {words} (association {number})"));
    }

    fn serve(&self, stream: TcpStream, number: u64) {
        let mut options = ServerAssociationOptions::new()
            .ae_access_control(Door(self))
            .ae_title(self.options.ae_title.clone())
            .max_pdu_length(PDU_BYTES)
            .read_timeout(SILENCE)
            .write_timeout(SILENCE)
            .with_abstract_syntax(uids::VERIFICATION);
        for class in STORAGE_CLASSES {
            options = options.with_abstract_syntax(class);
        }
        for syntax in transfer_syntaxes() {
            options = options.with_transfer_syntax(syntax);
        }
        let association = match options.establish(stream) {
            Ok(association) => association,
            // The door has said why; who only looked in is nobody.
            Err(dicom_ul::association::Error::Rejected { .. } | dicom_ul::association::Error::ConnectionClosed { .. }) => return,
            Err(_) => {
                let words = format!("what came to the DICOM port is no association request (connection {number}); it is closed");
                return self.say("DICOM garbage", words);
            }
        };
        self.say_unread(association.presentation_contexts(), number);
        let mut served = Served { shared: self, association, number, command: Vec::new(), state: State::Idle };
        let whole = served.run();
        if let State::Storing { incoming, .. } = &served.state {
            self.tell(Sighting::Trouble(Trouble::HalfReceived { association: number, bytes: incoming.bytes() }));
        }
        if !whole {
            // It may have gone already.
            let _ = served.association.abort();
        }
    }
}

/// Whether objects may come in this context.
fn is_agreed(offer: &PresentationContextNegotiated) -> bool {
    offer.reason == PresentationContextResultReason::Acceptance
}

/// Who may come in.
struct Door<'a>(&'a Shared);

impl AccessControl for Door<'_> {
    fn check_access(
        &self,
        this_ae_title: &str,
        calling_ae_title: &str,
        called_ae_title: &str,
        _user_identity: Option<&UserIdentity>,
    ) -> Result<(), AssociationRJServiceUserReason> {
        let allowed = &self.0.options.calling_ae_titles;
        let (reason, words) = if called_ae_title != this_ae_title {
            let words = format!("it calls {called_ae_title:?}, expected {this_ae_title:?}");
            (AssociationRJServiceUserReason::CalledAETitleNotRecognized, words)
        } else if !allowed.is_empty() && !allowed.iter().any(|known| known == calling_ae_title) {
            let words = format!("it is {calling_ae_title:?}, expected one of {allowed:?}");
            (AssociationRJServiceUserReason::CallingAETitleNotRecognized, words)
        } else {
            return Ok(());
        };
        self.0.say("DICOM association refused", format!("a DICOM association is refused: {words} as AE title"));
        Err(reason)
    }
}

/// What the next data fragment belongs to.
enum State {
    Idle,
    /// An object on its way into the folder.
    Storing {
        request: Request,
        context: u8,
        incoming: Box<Incoming>,
    },
    /// A data set that nobody wants; its request is answered at its end.
    Passing {
        request: Request,
        outcome: Outcome,
    },
}

struct Served<'a> {
    shared: &'a Shared,
    association: ServerAssociation<TcpStream>,
    number: u64,
    command: Vec<u8>,
    state: State,
}

impl Served<'_> {
    /// Until the association ends; whether that was in order.
    fn run(&mut self) -> bool {
        loop {
            match self.association.receive() {
                Ok(Pdu::PData { data }) => {
                    for value in data {
                        if self.take(value).is_none() {
                            return false;
                        }
                    }
                }
                Ok(Pdu::ReleaseRQ) => return self.association.send(&Pdu::ReleaseRP).is_ok(),
                Ok(Pdu::AbortRQ {
                    source: AbortRQSource::ServiceUser | AbortRQSource::ServiceProvider(_) | AbortRQSource::Reserved,
                }) => {
                    return true;
                }
                Ok(_) | Err(_) => return false,
            }
        }
    }

    /// One fragment; `None` where the association is to be ended.
    fn take(&mut self, value: PDataValue) -> Option<()> {
        match value.value_type {
            PDataValueType::Command => {
                self.command.extend(&value.data);
                if !matches!(self.state, State::Idle) || self.command.len() > MOST_COMMAND_BYTES {
                    return None;
                }
                if value.is_last {
                    let command = std::mem::take(&mut self.command);
                    self.begin(Request::parse(&command)?, value.presentation_context_id)?;
                }
            }
            PDataValueType::Data => self.data(&value)?,
        }
        Some(())
    }

    /// A request is whole: it is answered, or its data set begins.
    fn begin(&mut self, request: Request, context: u8) -> Option<()> {
        // A context that was turned down is listed as well, under a syntax that nobody agreed on.
        let agreed =
            self.association.presentation_contexts().iter().find(|offered| offered.id == context && is_agreed(offered))?;
        let outcome = if request.is_echo() {
            Outcome::Success
        } else if !request.is_store() {
            Outcome::Unrecognized
        } else if agreed.abstract_syntax != request.class || request.class == uids::VERIFICATION {
            Outcome::ClassNotSupported
        } else if !request.is_identified() || !request.has_data {
            Outcome::CannotUnderstand
        } else {
            match self.shared.spool.begin(&request.class, &request.instance, &agreed.transfer_syntax) {
                Ok(incoming) => {
                    self.state = State::Storing { request, context, incoming: Box::new(incoming) };
                    return Some(());
                }
                Err(error) => self.refuse(&error),
            }
        };
        if request.has_data {
            self.state = State::Passing { request, outcome };
            return Some(());
        }
        self.answer(&request, context, outcome)
    }

    fn data(&mut self, value: &PDataValue) -> Option<()> {
        match std::mem::replace(&mut self.state, State::Idle) {
            State::Idle => None,
            State::Passing { request, outcome } if value.is_last => self.answer(&request, value.presentation_context_id, outcome),
            State::Passing { request, outcome } => {
                self.state = State::Passing { request, outcome };
                Some(())
            }
            State::Storing { request, context, mut incoming } => match incoming.write(&value.data) {
                Ok(()) if value.is_last => {
                    let outcome = match incoming.finish(&self.shared.spool) {
                        Ok(Taken::New) => Outcome::Success,
                        Ok(Taken::Again) => {
                            let words = "an object came over DICOM that had come before, byte for byte: it is no new frame";
                            self.shared.say("DICOM object again", words.to_owned());
                            Outcome::Success
                        }
                        Err(error) => self.refuse(&error),
                    };
                    self.answer(&request, context, outcome)
                }
                Ok(()) => {
                    self.state = State::Storing { request, context, incoming };
                    Some(())
                }
                Err(error @ SpoolError::TooLarge { .. }) => {
                    // There may be no end to it.
                    self.refuse(&error);
                    None
                }
                Err(error) => {
                    let outcome = self.refuse(&error);
                    drop(incoming);
                    if value.is_last {
                        return self.answer(&request, context, outcome);
                    }
                    self.state = State::Passing { request, outcome };
                    Some(())
                }
            },
        }
    }

    fn refuse(&self, error: &SpoolError) -> Outcome {
        self.shared.tell(Sighting::Trouble(Trouble::NotReceived { association: self.number, detail: error.to_string() }));
        Outcome::OutOfResources
    }

    fn answer(&mut self, request: &Request, context: u8, outcome: Outcome) -> Option<()> {
        let data = request.response(outcome);
        let value = PDataValue { presentation_context_id: context, value_type: PDataValueType::Command, is_last: true, data };
        self.association.send(&Pdu::PData { data: vec![value] }).ok()
    }
}
