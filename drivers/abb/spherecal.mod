MODULE Spherecal
    ! spherecal on an ABB IRC5, RobotWare 5 and 6: this module answers the lines of docs/abb_protocol.md.
    ! It needs one of spherecal_tcp.mod (616-1 PC Interface) or spherecal_serial.mod beside it, and a
    ! main that calls SphServe (spherecal_main.mod). Never run on hardware: read INSTALL.html first.
    !
    ! A RAPID string holds 80 characters: a line is at most 79 and a line feed.

    ! The camera's mass and centre of gravity belong here. The frame stays that of the flange.
    PERS tooldata sphTool:=[TRUE,[[0,0,0],[1,0,0,0]],[1,[0,0,50],[1,0,0,0],0,0,0]];

    ! The tables of drivers/abb/protocol.py; a test compares them.
    CONST num SPH_VERSION:=1;
    CONST num SPH_LONGEST:=79;
    CONST num SPH_LAST_EPOCH:=999;
    CONST num SPH_ANGLE_DEC:=5;
    CONST num SPH_ANGLE_WID:=9;
    CONST num SPH_LENGTH_DEC:=3;
    CONST num SPH_QUAT_DEC:=6;
    CONST num SPH_TOKEN_LIFE:=5;
    CONST num SPH_FASTEST:=60;
    CONST num SPH_BAD_SUM:=1;
    CONST num SPH_BAD_SYNTAX:=2;
    CONST num SPH_BAD_VERB:=3;
    CONST num SPH_BAD_EPOCH:=4;
    CONST num SPH_BAD_TOKEN:=5;
    CONST num SPH_EXPIRED:=6;
    CONST num SPH_BUSY:=7;
    CONST num SPH_BAD_SPEED:=8;
    CONST num SPH_BAD_NUMBER:=9;
    CONST num SPH_NONE:=0;
    CONST num SPH_RUNNING:=1;
    CONST num SPH_REACHED:=2;
    CONST num SPH_STOPPED:=3;
    CONST num SPH_LINK_LOST:=4;
    CONST num SPH_SILENCE:=5;
    CONST num SPH_HELD:=6;

    ! How often a moving robot looks at the line, how long it then waits for another request, and how
    ! long a silence between two looks means that the program was held in between.
    CONST num SPH_POLL:=0.1;
    CONST num SPH_LINGER:=0.05;
    CONST num SPH_GAP:=0.6;
    CONST num SPH_MOST_LINES:=4;
    CONST num SPH_RAMP:=0.5;

    ! Kept when the program starts anew: every start is another epoch.
    PERS num sphEpoch:=0;

    ! Set by the line module.
    VAR bool sphLinkUp:=FALSE;
    VAR string sphChunk:="";

    ! Variables get these values when the program pointer goes to main, and keep theirs over ExitCycle.
    VAR bool sphBegun:=FALSE;
    VAR clock sphClock;
    VAR intnum sphPollInt;
    VAR num sphHeardAt:=0;
    VAR num sphSeenAt:=0;
    VAR bool sphMoving:=FALSE;
    VAR bool sphGo:=FALSE;
    VAR bool sphStop:=FALSE;
    VAR bool sphHeldNow:=FALSE;
    VAR num sphOutcome:=0;
    VAR num sphLastToken:=0;
    VAR num sphTokenNo:=0;
    VAR num sphGivenAt:=0;
    VAR num sphWatchdog:=3;
    VAR num sphTime:=1;
    VAR jointtarget sphTarget;
    VAR string sphRest:="";
    VAR bool sphOver:=FALSE;
    VAR num sphLines:=0;
    VAR string sphWord{10};
    VAR num sphWords:=0;
    VAR string sphCacheIn:="";
    VAR string sphCacheOut:="";
    PERS tooldata sphActTool:=[TRUE,[[0,0,0],[1,0,0,0]],[0.001,[0,0,0.001],[1,0,0,0],0,0,0]];
    PERS wobjdata sphActWobj:=[FALSE,TRUE,"",[[0,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];

    ! ---- the loop -------------------------------------------------------------------------------

    PROC SphServe()
        IF NOT sphBegun SphBegin;
        ! PP to Routine or PP to Cursor keep the variables: whatever was under way or asked for is over.
        IF sphOutcome=SPH_RUNNING sphOutcome:=SPH_HELD;
        sphTokenNo:=0;
        sphGo:=FALSE;
        sphStop:=FALSE;
        sphHeldNow:=FALSE;
        sphMoving:=FALSE;
        ConfJ\Off;
        ConfL\Off;
        WHILE TRUE DO
            IF sphLinkUp THEN
                SphHear 1,1;
                sphStop:=FALSE;
                IF sphGo SphMoveNow;
                IF ClkRead(sphClock)-sphHeardAt>5 SphNewcomer;
                IF ClkRead(sphClock)>10000 AND sphTokenNo=0 SphWind;
            ELSE
                sphTokenNo:=0;
                sphCacheIn:="";
                sphRest:="";
                sphOver:=FALSE;
                SphOpen;
                sphHeardAt:=ClkRead(sphClock);
            ENDIF
        ENDWHILE
    ENDPROC

    ! A program start: another epoch, and nothing that was asked before it is known any more.
    PROC SphBegin()
        sphEpoch:=(sphEpoch MOD SPH_LAST_EPOCH)+1;
        sphOutcome:=SPH_NONE;
        sphLastToken:=0;
        sphTokenNo:=0;
        sphGo:=FALSE;
        sphCacheIn:="";
        sphCacheOut:="";
        SphWind;
        SphClose;
        sphLinkUp:=FALSE;
        sphBegun:=TRUE;
    ENDPROC

    ! A num holds seven digits: the clock is set back before it becomes coarse.
    PROC SphWind()
        ClkReset sphClock;
        ClkStart sphClock;
        sphHeardAt:=0;
    ENDPROC

    ! The only place where the robot is moved. sphGo is spent before the motion begins.
    PROC SphMoveNow()
        sphMoving:=TRUE;
        sphGo:=FALSE;
        IF ClkRead(sphClock)-sphGivenAt>SPH_TOKEN_LIFE SphGiveUp SPH_HELD;
        sphSeenAt:=ClkRead(sphClock);
        SphArm;
        IF sphHeldNow SphGiveUp SPH_HELD;
        MoveAbsJ sphTarget\NoEOffs,v1000\T:=sphTime,fine,sphTool;
        sphMoving:=FALSE;
        sphOutcome:=SPH_REACHED;
        SphDisarm;
    ENDPROC

    ! ExitCycle takes interrupts away, so each motion connects its own.
    PROC SphArm()
        SphDisarm;
        CONNECT sphPollInt WITH SphPoll;
        ITimer SPH_POLL,sphPollInt;
    ENDPROC

    PROC SphDisarm()
        IDelete sphPollInt;
    ERROR
        TRYNEXT;
    ENDPROC

    TRAP SphPoll
        IF NOT sphMoving RETURN;
        SphLook;
        IF sphHeldNow SphGiveUp SPH_HELD;
        SphHear SPH_LINGER,SPH_MOST_LINES;
        SphLook;
        IF sphHeldNow SphGiveUp SPH_HELD;
        IF sphStop SphGiveUp SPH_STOPPED;
        IF NOT sphLinkUp SphGiveUp SPH_LINK_LOST;
        IF ClkRead(sphClock)-sphHeardAt>sphWatchdog SphGiveUp SPH_SILENCE;
    ENDTRAP

    ! A long time between two looks: the program was held in between.
    PROC SphLook()
        IF ClkRead(sphClock)-sphSeenAt>SPH_GAP sphHeldNow:=TRUE;
        sphSeenAt:=ClkRead(sphClock);
    ENDPROC

    ! Stop, forget the path, begin again at main: the motion cannot go on after this.
    PROC SphGiveUp(num outcome)
        sphOutcome:=outcome;
        sphMoving:=FALSE;
        sphGo:=FALSE;
        sphTokenNo:=0;
        IF NOT (IsStopMoveAct(\FromMoveTask) OR IsStopMoveAct(\FromNonMoveTask)) StopMove\Quick;
        ClearPath;
        StartMove;
        ExitCycle;
    ENDPROC

    ! Event routine for the event RESTART (Start pressed while the program was held): what was asked for and
    ! not begun is forgotten, and nothing moves until SphPoll has given up what was begun.
    PROC SphOnRestart()
        sphTokenNo:=0;
        IF sphGo sphOutcome:=SPH_HELD;
        sphGo:=FALSE;
        IF sphMoving THEN
            sphHeldNow:=TRUE;
            StopMove\Quick;
        ENDIF
    ENDPROC

    ! ---- lines ----------------------------------------------------------------------------------

    ! Answers what comes: up to so many lines, each within so many seconds of the one before.
    PROC SphHear(num seconds,num most)
        sphLines:=0;
        WHILE sphLinkUp AND sphLines<most DO
            IF NOT SphReceive(seconds) RETURN;
            IF sphMoving SphLook;
            SphFeed;
            IF sphGo OR sphStop RETURN;
        ENDWHILE
    ENDPROC

    ! Cuts sphChunk into lines.
    PROC SphFeed()
        VAR num start:=1;
        VAR num found;

        WHILE start<=StrLen(sphChunk) DO
            found:=StrFind(sphChunk,start,"\0A");
            IF found>start SphAppend StrPart(sphChunk,start,found-start);
            IF found<=StrLen(sphChunk) SphLine;
            start:=found+1;
        ENDWHILE
    ENDPROC

    PROC SphAppend(string part)
        IF sphOver RETURN;
        IF StrLen(sphRest)+StrLen(part)>SPH_LONGEST+1 THEN
            sphOver:=TRUE;
            sphRest:="";
        ELSE
            sphRest:=sphRest+part;
        ENDIF
    ENDPROC

    PROC SphLine()
        VAR string line;

        line:=sphRest;
        sphRest:="";
        sphLines:=sphLines+1;
        IF StrLen(line)>1 THEN
            IF StrPart(line,StrLen(line),1)="\0D" line:=StrPart(line,1,StrLen(line)-1);
        ENDIF
        IF sphOver OR (NOT SphIsLine(line)) THEN
            sphOver:=FALSE;
            SphRefuse "0000",SPH_BAD_SUM,"checksum";
        ELSE
            sphHeardAt:=ClkRead(sphClock);
            SphSplit StrPart(line,1,StrLen(line)-3);
            SphAnswer line;
        ENDIF
    ENDPROC

    FUNC bool SphIsLine(string line)
        VAR num n;

        n:=StrLen(line);
        IF n<9 OR n>SPH_LONGEST RETURN FALSE;
        IF StrPart(line,n-2,1)<>"*" RETURN FALSE;
        IF StrPart(line,5,1)<>" " RETURN FALSE;
        RETURN (StrPart(line,n-1,2)=SphSum(StrPart(line,1,n-3)));
    ENDFUNC

    FUNC string SphSum(string body)
        VAR num sum:=0;

        FOR i FROM 1 TO StrLen(body) DO
            sum:=(31*sum+StrToByte(StrPart(body,i,1)\Char)) MOD 251;
        ENDFOR
        RETURN ByteToStr(sum\Hex);
    ENDFUNC

    PROC SphSplit(string body)
        VAR num start:=1;
        VAR num found;

        sphWords:=0;
        WHILE start<=StrLen(body) AND sphWords<10 DO
            found:=StrFind(body,start," ");
            IF found>start THEN
                sphWords:=sphWords+1;
                sphWord{sphWords}:=StrPart(body,start,found-start);
            ENDIF
            start:=found+1;
        ENDWHILE
    ENDPROC

    ! One answer to one request. A request that came before gets the same words and nothing is done.
    PROC SphAnswer(string line)
        IF sphWord{2}="HELLO" sphCacheIn:="";
        IF StrLen(sphCacheIn)>4 THEN
            IF line=sphCacheIn THEN
                SphSend sphCacheOut;
                RETURN;
            ENDIF
            IF StrPart(line,1,4)=StrPart(sphCacheIn,1,4) THEN
                SphRefuse sphWord{1},SPH_BAD_NUMBER,"number used for another request";
                RETURN;
            ENDIF
        ENDIF
        sphCacheIn:=line;
        IF sphWord{2}="HELLO" THEN
            SphReply "H "+NumToStr(SPH_VERSION,0)+" "+NumToStr(sphEpoch,0);
        ELSEIF sphWord{2}="INFO" THEN
            SphInfo;
        ELSEIF sphWord{2}="TOOL" THEN
            SphTellTool;
        ELSEIF sphWord{2}="J" THEN
            SphState;
        ELSEIF sphWord{2}="POSE" THEN
            SphPose;
        ELSEIF sphWord{2}="TARGET" THEN
            SphGiven;
        ELSEIF sphWord{2}="GO" THEN
            SphStart;
        ELSEIF sphWord{2}="LAST" THEN
            SphReply "L "+NumToStr(sphEpoch,0)+" "+NumToStr(sphLastToken,0)+" "+NumToStr(sphOutcome,0);
        ELSEIF sphWord{2}="STOP" THEN
            sphTokenNo:=0;
            IF sphGo sphOutcome:=SPH_STOPPED;
            sphGo:=FALSE;
            IF sphMoving sphStop:=TRUE;
            SphReply "S "+NumToStr(sphEpoch,0);
        ELSE
            SphRefuse sphWord{1},SPH_BAD_VERB,"unknown verb";
        ENDIF
    ENDPROC

    PROC SphReply(string body)
        VAR string text;

        text:=sphWord{1}+" "+body;
        text:=text+"*"+SphSum(text);
        sphCacheOut:=text;
        SphSend text;
    ENDPROC

    PROC SphRefuse(string number,num fault,string why)
        VAR string text;

        text:=number+" E "+NumToStr(fault,0)+" "+why;
        text:=text+"*"+SphSum(text);
        IF number<>"0000" AND fault<>SPH_BAD_NUMBER sphCacheOut:=text;
        SphSend text;
    ENDPROC

    ! ---- requests -------------------------------------------------------------------------------

    PROC SphInfo()
        VAR string text:="";

        IF sphWords<>3 THEN
            SphRefuse sphWord{1},SPH_BAD_SYNTAX,"syntax";
            RETURN;
        ENDIF
        IF sphWord{3}="1" THEN
            text:=GetSysInfo(\SerialNo);
        ELSEIF sphWord{3}="2" THEN
            text:=GetSysInfo(\SWVersion);
        ELSEIF sphWord{3}="3" THEN
            text:=GetSysInfo(\RobotType);
        ELSE
            SphRefuse sphWord{1},SPH_BAD_SYNTAX,"syntax";
            RETURN;
        ENDIF
        IF StrLen(text)>60 text:=StrPart(text,1,60);
        SphReply "I "+sphWord{3}+" "+StrMap(text,"*","-");
    ENDPROC

    PROC SphTellTool()
        VAR string toolName:="";
        VAR string wobjName:="";

        GetSysData sphActTool\ObjectName:=toolName;
        GetSysData sphActWobj\ObjectName:=wobjName;
        SphReply "W "+toolName+" "+wobjName;
    ENDPROC

    PROC SphState()
        VAR jointtarget here;
        VAR string body;

        here:=CJointT();
        body:="J "+NumToStr(sphEpoch,0)+" "+SphAngle(here.robax.rax_1)+" "+SphAngle(here.robax.rax_2);
        body:=body+" "+SphAngle(here.robax.rax_3)+" "+SphAngle(here.robax.rax_4);
        body:=body+" "+SphAngle(here.robax.rax_5)+" "+SphAngle(here.robax.rax_6);
        SphReply body+" "+SphMotion()+SphMode()+"--";
    ENDPROC

    FUNC string SphMotion()
        IF sphMoving OR sphGo RETURN "M";
        IF sphOutcome=SPH_NONE RETURN "R";
        IF sphOutcome=SPH_REACHED RETURN "D";
        RETURN "X";
    ENDFUNC

    FUNC string SphMode()
        IF OpMode()=OP_AUTO RETURN "A";
        IF OpMode()=OP_MAN_PROG RETURN "R";
        IF OpMode()=OP_MAN_TEST RETURN "F";
        RETURN "U";
    ENDFUNC

    ! Five decimals where they fit into nine characters, else four.
    FUNC string SphAngle(num degrees)
        VAR string text;

        text:=NumToStr(degrees,SPH_ANGLE_DEC);
        IF StrLen(text)>SPH_ANGLE_WID text:=NumToStr(degrees,SPH_ANGLE_DEC-1);
        RETURN text;
    ENDFUNC

    ! Always the flange in the world frame, whatever tool is active.
    PROC SphPose()
        VAR robtarget here;
        VAR string body;

        here:=CRobT(\Tool:=tool0\WObj:=wobj0);
        body:="P "+NumToStr(here.trans.x,SPH_LENGTH_DEC)+" "+NumToStr(here.trans.y,SPH_LENGTH_DEC);
        body:=body+" "+NumToStr(here.trans.z,SPH_LENGTH_DEC);
        body:=body+" "+NumToStr(here.rot.q1,SPH_QUAT_DEC)+" "+NumToStr(here.rot.q2,SPH_QUAT_DEC);
        body:=body+" "+NumToStr(here.rot.q3,SPH_QUAT_DEC)+" "+NumToStr(here.rot.q4,SPH_QUAT_DEC);
        SphReply body;
    ENDPROC

    ! A target is told back as it was understood; its number is the token that starts it, once.
    PROC SphGiven()
        VAR jointtarget asked;
        VAR num token;
        VAR bool ok;
        VAR string body;

        IF sphMoving OR sphGo THEN
            SphRefuse sphWord{1},SPH_BUSY,"moving";
            RETURN;
        ENDIF
        asked:=CJointT();
        ok:=(sphWords=8);
        IF ok ok:=StrToVal(sphWord{1},token);
        IF ok ok:=StrToVal(sphWord{3},asked.robax.rax_1);
        IF ok ok:=StrToVal(sphWord{4},asked.robax.rax_2);
        IF ok ok:=StrToVal(sphWord{5},asked.robax.rax_3);
        IF ok ok:=StrToVal(sphWord{6},asked.robax.rax_4);
        IF ok ok:=StrToVal(sphWord{7},asked.robax.rax_5);
        IF ok ok:=StrToVal(sphWord{8},asked.robax.rax_6);
        IF NOT ok THEN
            SphRefuse sphWord{1},SPH_BAD_SYNTAX,"syntax";
            RETURN;
        ENDIF
        sphTarget:=asked;
        sphTokenNo:=token;
        sphGivenAt:=ClkRead(sphClock);
        body:="T "+SphAngle(asked.robax.rax_1)+" "+SphAngle(asked.robax.rax_2)+" "+SphAngle(asked.robax.rax_3);
        body:=body+" "+SphAngle(asked.robax.rax_4)+" "+SphAngle(asked.robax.rax_5)+" "+SphAngle(asked.robax.rax_6);
        SphReply body;
    ENDPROC

    PROC SphStart()
        VAR num epoch;
        VAR num token;
        VAR num speed;
        VAR num watchdog;
        VAR num given;
        VAR bool ok;

        IF sphMoving OR sphGo THEN
            SphRefuse sphWord{1},SPH_BUSY,"moving";
            RETURN;
        ENDIF
        ok:=(sphWords=6);
        IF ok ok:=StrToVal(sphWord{3},epoch);
        IF ok ok:=StrToVal(sphWord{4},token);
        IF ok ok:=StrToVal(sphWord{5},speed);
        IF ok ok:=StrToVal(sphWord{6},watchdog);
        IF NOT ok THEN
            SphRefuse sphWord{1},SPH_BAD_SYNTAX,"syntax";
            RETURN;
        ENDIF
        IF epoch<>sphEpoch THEN
            SphRefuse sphWord{1},SPH_BAD_EPOCH,"another epoch";
            RETURN;
        ENDIF
        given:=sphTokenNo;
        sphTokenNo:=0;
        IF given=0 OR given<>token THEN
            SphRefuse sphWord{1},SPH_BAD_TOKEN,"no such target";
        ELSEIF ClkRead(sphClock)-sphGivenAt>SPH_TOKEN_LIFE THEN
            SphRefuse sphWord{1},SPH_EXPIRED,"target expired";
        ELSEIF speed<=0 OR speed>SPH_FASTEST OR watchdog<=0 OR watchdog>30 THEN
            SphRefuse sphWord{1},SPH_BAD_SPEED,"speed";
        ELSE
            sphTime:=SphWay()/speed+SPH_RAMP;
            sphWatchdog:=watchdog;
            sphLastToken:=token;
            sphOutcome:=SPH_RUNNING;
            sphGo:=TRUE;
            SphReply "G "+sphWord{3}+" "+sphWord{4}+" "+NumToStr(sphTime,2);
        ENDIF
    ENDPROC

    ! The longest way of an axis to the target, in degrees.
    FUNC num SphWay()
        VAR jointtarget here;
        VAR num way;

        here:=CJointT();
        way:=Abs(sphTarget.robax.rax_1-here.robax.rax_1);
        way:=SphMore(way,sphTarget.robax.rax_2-here.robax.rax_2);
        way:=SphMore(way,sphTarget.robax.rax_3-here.robax.rax_3);
        way:=SphMore(way,sphTarget.robax.rax_4-here.robax.rax_4);
        way:=SphMore(way,sphTarget.robax.rax_5-here.robax.rax_5);
        RETURN SphMore(way,sphTarget.robax.rax_6-here.robax.rax_6);
    ENDFUNC

    FUNC num SphMore(num way,num difference)
        IF Abs(difference)>way RETURN Abs(difference);
        RETURN way;
    ENDFUNC
ENDMODULE
